"""The script for a GPU machine runs from end to end, here in tiny sizes on the CPU."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "sota-check" / "run_ficreg_gpu.sh"
FOLDERS = [str(ROOT / "benchmarks"), str(ROOT / "tools" / "gpu")]  # of the modules that the script runs
NAMES = {f"{env}_{method}" for env in ("two_room", "push_t") for method in ("lewm", "ficreg")}


def begin(*arguments: str, python: str = sys.executable) -> subprocess.Popen:
    environment = {key: value for key, value in os.environ.items() if key not in ("OUT", "PYTHONPATH")}
    environment |= {"PYTHON": python, "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(["bash", str(SCRIPT), *arguments], env=environment, text=True, **pipes)


def execute(*arguments: str, python: str = sys.executable) -> subprocess.CompletedProcess:
    process = begin(*arguments, python=python)
    stdout, stderr = process.communicate(timeout=1800)
    return subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)


@pytest.fixture
def tools(monkeypatch) -> Iterator[None]:
    """Makes the script's modules importable and removes them from ``sys.modules`` afterwards."""
    for folder in FOLDERS:
        monkeypatch.syspath_prepend(folder)
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith((*FOLDERS, str(ROOT / "sota-"))):
            del sys.modules[name]


@pytest.mark.slow
def test_two_slots_make_one_report(tmp_path):
    """A slot without time does nothing and says so; the same command in the next one does the rest."""
    pytest.importorskip("pymunk")
    folders = ("--work", str(tmp_path / "work"), "--out", str(tmp_path / "out"), "--dry-run")
    first = execute(*folders, "--minutes", "0")
    assert first.returncode == 75 and "the same command continues" in first.stdout, first.stderr
    report = json.loads((tmp_path / "out" / "ficreg_gpu.json").read_text())
    assert not report["complete"] and set(report["unfinished"]) == NAMES

    second = execute(*folders)
    assert second.returncode == 0, f"{second.stderr}\n{(tmp_path / 'out' / 'log.txt').read_text()[-3000:]}"
    report = json.loads((tmp_path / "out" / "ficreg_gpu.json").read_text())
    assert report["complete"] and set(report["results"]) == NAMES and len(report["slots"]) == 2
    for env in ("two_room", "push_t"):
        for method in ("lewm", "ficreg"):
            assert report["results"][f"{env}_{method}"]["policy"]["pairs_hash"] == report["pairs_hash"][env]
    profile = report["profile"]
    assert 0 <= profile["loader_share"] <= 1 and 0 < profile["share_of_peak"] < 1
    assert profile["operations_per_step"] > profile["frames"] * 5e6 * 2  # more than one look at each weight
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    pictures = ["profile.png", "push_t.gif", "success.png", "training.png", "two_room.gif"]
    assert written == sorted(["ficreg_gpu.json", "log.txt", *pictures])


def test_a_python_without_torch_and_an_unknown_option_are_refused(tmp_path):
    (bare := tmp_path / "python").write_text("#!/bin/sh\nexit 1\n")
    bare.chmod(0o755)
    for option, python, words in (("--work", str(bare), "has no torch"), ("--wheel", sys.executable, "unknown option --wheel")):
        done = execute(option, str(tmp_path / "w"), python=python)
        assert done.returncode == 2 and words in done.stderr


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_slot_that_is_cut_short_leaves_a_report_and_no_process(tmp_path, how):
    process = begin("--work", str(tmp_path / "work"), "--out", str(tmp_path / "out"), "--dry-run")
    assert process.stdout.readline().startswith("two_room_lewm")  # the first run begins
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    await_true(children.read_text)
    (child,) = children.read_text().split()
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode == (75 if how == signal.SIGTERM else -how)
    report = json.loads((tmp_path / "out" / "ficreg_gpu.json").read_text())
    assert set(report["unfinished"]) == NAMES and len(report["slots"]) == 1
    await_true(lambda: not Path(f"/proc/{child}").exists())


def await_true(claim) -> None:
    stop_at = time.monotonic() + 30
    while not claim():
        assert time.monotonic() < stop_at
        time.sleep(0.05)


def test_a_span_of_kernels_is_not_counted_beside_them(tools):
    from step_profile import seconds_by_name

    cuda, cpu = torch.autograd.DeviceType.CUDA, torch.autograd.DeviceType.CPU
    rows = [("gemm", cuda, False, 3.0), ("adamw", cuda, False, 1.0), ("Optimizer.step", cuda, True, 1.0)]
    rows += [("aten::mm", cpu, False, 3.0)]
    events = [
        SimpleNamespace(key=key, device_type=kind, is_user_annotation=user, self_device_time_total=spent)
        for key, kind, user, spent in rows
    ]
    assert seconds_by_name(events, cuda=True) == {"gemm": 3.0, "adamw": 1.0}


def test_bytes_for_many_clips_are_drawn_on_from_few(tools):
    from scaling import memory

    rows = [{"clips": clips, "kept_bytes": 100 + 7 * clips, "state_bytes": 5} for clips in (2, 4, 8)]
    expected = {"state": 5, "constant": 100, "per_clip": 7, "activations": 100 + 7 * 128}
    assert memory({"model": rows}) == {"model": expected}
