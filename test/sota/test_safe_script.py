"""train.py is told to make room, to begin anew, to begin from a checkpoint, to keep the best; its folder explains itself."""

from __future__ import annotations

import importlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from torchrl_ficreg.trainers import find_checkpoint, load_world_model

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
RUN = "runs/two_room_cpu_ficreg_seed0"


def weights(folder):
    model, inverse_model, _ = load_world_model(folder)
    return [*model.state_dict().values(), *inverse_model.state_dict().values()]


@pytest.fixture
def beside(trained, tmp_path):
    """An empty folder beside the recorded episodes."""
    (tmp_path / "data").symlink_to(trained / "data")
    return tmp_path


def test_a_preempted_job_exits_with_85_and_the_same_command_ends_as_an_unbroken_one(
    trained, beside, command, environment, execute
):
    """SIGTERM in the first epoch of four, where no checkpoint of an epoch helps. Success is measured on the way."""
    line = ["optim.epochs=4", "logger.interval=1", "evaluation.every=2", "evaluation.every_pairs=2"]
    process = subprocess.Popen(command("train.py", *line), cwd=beside, env=environment, stderr=subprocess.PIPE, text=True)
    table = beside / RUN / "metrics.csv"
    while process.poll() is None and not (table.exists() and table.read_bytes().count(b"\n") >= 3):
        time.sleep(0.001)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 85
    assert err.strip().endswith("stopped by SIGTERM: the same command continues where it stopped.")
    assert "Traceback" not in err
    (left,) = (beside / RUN / "checkpoints").iterdir()
    done = execute(beside, "train.py", *line)
    assert done.returncode == 0, done.stderr
    assert "continuing" in done.stdout
    assert not left.exists()
    assert table.read_text().count("evaluation") == 2
    find_checkpoint(beside / RUN, best=True)
    whole = execute(beside, "train.py", "optim.epochs=4", "name=whole")
    assert whole.returncode == 0, whole.stderr
    assert all(torch.equal(*pair) for pair in zip(weights(beside / RUN), weights(beside / "runs" / "whole"), strict=True))
    text = (beside / RUN / "README.txt").read_text()
    assert "optim.epochs=4" in text and f"checkpoint={RUN}" in text
    explained = {line.split()[0].rstrip("/,") for line in text.splitlines() if line and not line.startswith(" ")}
    assert {path.name for path in (beside / RUN).iterdir()} - {"README.txt"} <= explained


def test_resume_never_refuses_what_is_there_and_a_path_begins_from_it(trained, copy, execute):
    """The run of one epoch, begun from its own last checkpoint under another name, has nothing left to train."""
    refused = execute(copy, "train.py", "resume=never")
    assert refused.returncode == 1
    assert "holds a run and resume=never" in refused.stderr
    other = execute(copy, "train.py", "name=other", f"resume={RUN}")
    assert other.returncode == 0, other.stderr
    assert "train:" not in other.stderr
    assert all(torch.equal(*pair) for pair in zip(weights(copy / RUN), weights(trained / RUN), strict=True))
    differs = execute(copy, "train.py", "name=third", f"resume={RUN}", "optim.lr=1")
    assert differs.returncode == 1 and "was made with other settings (optim.lr: 0.0005 -> 1" in differs.stderr
    absent = execute(copy, "train.py", "name=third", "resume=nowhere")
    assert absent.returncode == 1 and "no checkpoint at nowhere" in absent.stderr
    assert not (copy / "runs" / "third").exists()


def test_a_sweep_under_torchrun_is_refused_by_every_process_before_anything_begins(monkeypatch):
    """The second job would meet on the store of the first, and wait for ever. One process on its own may sweep."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    start = importlib.import_module("cli").entry_point("train")(lambda config: pytest.fail("begun"))
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "seed=0,1"])
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in "01":
        monkeypatch.setenv("RANK", rank)
        with pytest.raises(SystemExit) as caught:
            start()
        assert caught.value.code == (
            "error: under torchrun a sweep is one command for each run: start torchrun once per seed, or use -m with "
            "hydra/launcher=slurm."
        )
    sys.modules.pop("cli", None)
