"""train.py from an empty folder to a report: its files, repetition, continuation after a stop, loggers."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import subprocess
import time
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.trainers import find_checkpoint, load_world_model

RUN = "runs/two_room_cpu_ficreg_seed0"
DATA = "data/two_room_32px_20episodes_seed0"
GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "first_layout.zip"


def weights(folder):
    model, inverse_model, _ = load_world_model(folder)
    return {**model.state_dict(), **{f"inverse {name}": value for name, value in inverse_model.state_dict().items()}}


def outcomes(folder):
    results = json.loads((folder / "results.json").read_text())
    return {name: {k: v for k, v in results[name].items() if k != "seconds_per_plan"} for name in ("policy", "random")}


def test_a_run_leaves_exactly_the_documented_files(trained_once):
    """A run folder, a dataset, and no litter: no outputs/, no log, no half-written file. The pictures open."""
    folder, left = trained_once
    (checkpoint,) = {name for name in left if name.startswith(f"{RUN}/checkpoints/")}
    run = ["config.yaml", "episodes.gif", "latent_distance.png", "learning_curve.png", "metrics.csv", "pairs.json"]
    run += ["README.txt"]
    data = ["action.memmap", "episodes.jsonl", "meta.json", "pairs_4x25_seed0.json", "pixels.memmap", "state.memmap"]
    expected = {f"{RUN}/{name}" for name in [*run, "results.json"]} | {f"{DATA}/{name}" for name in data}
    assert left - {checkpoint} == expected
    assert all(imageio.imread(folder / RUN / name).std() > 5 for name in ("learning_curve.png", "latent_distance.png"))
    assert imageio.imread(folder / RUN / "episodes.gif").ndim == 4


def test_the_results_say_what_was_measured(trained):
    results = json.loads((trained / RUN / "results.json").read_text())
    assert set(results) == {"method", "search", "policy", "random", "latent_distance", "training", "versions"}
    assert results["method"] == "ficreg" and results["search"] == "cem"
    for name in ("policy", "random"):
        assert results[name]["pairs"] == 4 and results[name]["budget"] == 50
        assert 0 <= results[name]["success_rate"] <= 1
    assert results["policy"]["pairs_hash"] == results["random"]["pairs_hash"]
    assert results["policy"]["seconds_per_plan"] > 0 == results["random"]["seconds_per_plan"]
    data = OfflineTrajectories(trained / DATA, split="train", num_frames=2, frame_skip=5, batch_size=32)
    assert results["training"]["steps"] == data.batches_per_epoch
    assert results["training"]["dataset_fingerprint"] == data.fingerprint
    assert str(trained) not in json.dumps(results)


def test_the_same_command_elsewhere_gives_the_same_weights_and_outcomes(trained, execute, tmp_path):
    """This time the episodes come from two worker processes; three pairs at a time are evaluated."""
    done = execute(tmp_path, "train.py", "collect.num_workers=2", "evaluation.num_envs=3")
    assert done.returncode == 0, done.stderr
    first, second = weights(trained / RUN), weights(tmp_path / RUN)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert outcomes(trained / RUN) == outcomes(tmp_path / RUN)


def test_evaluate_repeats_the_outcome_bit_for_bit(trained, copy, execute, files):
    """The run's own plan settings, another number of environments; the run's own files stay as they are."""
    before = files(copy)
    done = execute(copy, "evaluate.py", f"checkpoint={RUN}", "num_envs=3", "record=1")
    assert done.returncode == 0, done.stderr
    (folder,) = (copy / RUN / "evaluation").iterdir()
    repeated = json.loads((folder / "results.json").read_text())
    expected = outcomes(trained / RUN)
    for policy in ("policy", "random"):
        for key, value in expected[policy].items():
            assert repeated[policy][key] == value, (policy, key)
    assert repeated["plan"]["num_candidates"] == 20, "the plan settings of the run hold unless others are typed"
    after = files(copy)
    new = {name for name in after if name not in before}
    names = ("config.yaml", "episodes.gif", "results.json")
    assert new == {f"{RUN}/evaluation/{folder.name}/{name}" for name in names}
    assert all(after[name] == before[name] for name in before)


def test_a_finished_command_given_again_trains_nothing(copy, execute, files):
    before = files(copy / RUN)
    done = execute(copy, "train.py", "evaluation.num_pairs=3")  # evaluation settings may change
    assert done.returncode == 0, done.stderr
    assert "train:" not in done.stderr and "collect:" not in done.stderr
    after = files(copy / RUN)
    unchanged = [name for name in before if name.startswith("checkpoints/") or name == "metrics.csv"]
    assert len(unchanged) == 2 and all(after[name] == before[name] for name in unchanged)
    results = json.loads(after["results.json"])
    assert results["policy"]["pairs"] == 3
    assert results["training"]["resumed_at_step"] == results["training"]["steps"]


def test_a_preempted_job_exits_with_85_and_the_same_command_ends_as_an_unbroken_one(beside, command, environment, execute):
    """SIGTERM in the first of two epochs, where no checkpoint of an epoch helps. Success is measured on the way."""
    line = ["optim.epochs=2", "logger.interval=1", "evaluation.every=1", "evaluation.every_pairs=2"]
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
    whole = execute(beside, "train.py", "optim.epochs=2", "name=whole")
    assert whole.returncode == 0, whole.stderr
    ours, theirs = weights(beside / RUN), weights(beside / "runs" / "whole")
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    text = (beside / RUN / "README.txt").read_text()
    assert "optim.epochs=2" in text and f"checkpoint={RUN}" in text
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
    ours, theirs = weights(copy / RUN), weights(trained / RUN)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    differs = execute(copy, "train.py", "name=third", f"resume={RUN}", "optim.lr=1")
    assert differs.returncode == 1 and "was made with other settings (optim.lr: 0.0005 -> 1" in differs.stderr
    absent = execute(copy, "train.py", "name=third", "resume=nowhere")
    assert absent.returncode == 1 and "no checkpoint at nowhere" in absent.stderr
    assert not (copy / "runs" / "third").exists()


def test_a_run_of_before_can_be_evaluated_and_continued(tmp_path, execute):
    """Made before modules and scripts were renamed: ``test/golden/first_layout.zip``."""
    shutil.unpack_archive(GOLDEN, tmp_path)
    before = find_checkpoint(tmp_path / RUN).read_bytes()
    done = execute(tmp_path, "evaluate.py", f"checkpoint={RUN}", "record=0")
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / RUN / "evaluation").iterdir()
    found, expected = outcomes(folder), outcomes(tmp_path / RUN)
    for policy in ("policy", "random"):
        assert all(found[policy][key] == expected[policy][key] for key in ("pairs_hash", "first_success_step"))
    overrides = shlex.split((tmp_path / RUN / "README.txt").read_text().split("python train.py ")[1].splitlines()[0])
    done = execute(tmp_path, "train.py", *overrides, tiny=False)
    assert done.returncode == 0, done.stderr
    assert "train:" not in done.stderr and "collect:" not in done.stderr
    assert find_checkpoint(tmp_path / RUN).read_bytes() == before


@pytest.mark.parametrize("stop", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_run_stopped_while_collecting_records_the_same_bytes_when_repeated(
    command, environment, execute, tmp_path, stop, files
):
    """Stopped after the first committed episodes, in the middle of recording; nothing else is running any more."""
    many = "env.data.episodes=60"  # seconds of recording, so that it is not over before a busy machine looks again
    data = DATA.replace("20episodes", "60episodes")
    folder, whole = tmp_path / "stopped", tmp_path / "whole"
    folder.mkdir(), whole.mkdir()
    process = subprocess.Popen(
        command("collect.py", "collect.num_workers=1", many),
        cwd=folder,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background job of a shell ignores it
    )
    index = folder / data / "episodes.jsonl"
    while process.poll() is None and not (index.exists() and index.read_bytes().count(b"\n") >= 2):
        time.sleep(0.001)
    process.send_signal(stop)
    _, err = process.communicate(timeout=60)
    assert index.read_bytes().count(b"\n") < 60, "the recording was over too soon"
    assert process.returncode != 0
    if stop == signal.SIGINT:
        assert err.strip().endswith("interrupted: the same command continues from what is on disk.")
        assert "Traceback" not in err
    for place in (folder, whole):
        done = execute(place, "collect.py", many)
        assert done.returncode == 0, done.stderr
        assert "60 episodes" in done.stdout
    recorded = files(folder / data)
    assert recorded == files(whole / data)
    assert len(recorded) == 5  # three arrays, their index and the header


@pytest.mark.parametrize("backend", ["tensorboard", pytest.param("wandb", marks=pytest.mark.slow)])
def test_lewm_trains_and_other_loggers_work(beside, execute, spawn, backend):
    """The baseline has its own run folder on the same data and no term of FICReg; its logger's files are inside it."""
    pytest.importorskip(backend)
    run = spawn if backend == "wandb" else execute  # wandb starts a service for the process
    done = run(beside, "train.py", "method=lewm", f"logger.backend={backend}", "logger.interval=5")
    assert done.returncode == 0, done.stderr
    run_dir = beside / "runs" / "two_room_cpu_lewm_seed0"
    header = (run_dir / "metrics.csv").read_text().splitlines()[0]
    assert "loss_pred" in header and "loss_idm" not in header and "loss_consistency" not in header
    assert json.loads((run_dir / "results.json").read_text())["method"] == "lewm"
    pattern = "events.out.*" if backend == "tensorboard" else "run-*.wandb"
    assert list((run_dir / backend).rglob(pattern))
    if backend == "wandb":
        media = {path.name for path in (run_dir / "wandb").rglob("files/media/*") if any(path.rglob("*.*"))}
        assert media == {"table", "images", "videos"}
    assert {path.name for path in beside.iterdir()} == {"data", "runs"}
