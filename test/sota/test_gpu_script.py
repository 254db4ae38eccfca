"""The script for a GPU machine runs from end to end, here in tiny sizes on the CPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "sota-check" / "run_ficreg_gpu.sh"
NAMES = {f"{env}_{method}" for env in ("two_room", "push_t") for method in ("lewm", "ficreg")}


def execute(*arguments: str, python: str = sys.executable) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if key not in ("OUT", "PYTHONPATH")}
    environment |= {"PYTHON": python, "OMP_NUM_THREADS": "1"}
    line = ["bash", str(SCRIPT), *arguments]
    return subprocess.run(line, env=environment, capture_output=True, text=True, timeout=1800)


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
            assert report["results"][f"{env}_{method}"][method]["pairs_hash"] == report["pairs_hash"][env]
    profile = report["profile"]
    assert 0 <= profile["loader_share"] <= 1 and 0 < profile["share_of_peak"] < 1
    assert profile["operations_per_step"] > profile["frames"] * 5e6 * 2  # more than one look at each weight
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    pictures = ["profile.png", "push_t.gif", "success.png", "training.png", "two_room.gif"]
    assert written == sorted(["ficreg_gpu.json", "log.txt", *pictures])


def test_a_python_without_torch_is_refused(tmp_path):
    bare = tmp_path / "python"
    bare.write_text("#!/bin/sh\nexit 1\n")
    bare.chmod(0o755)
    done = execute("--work", str(tmp_path / "w"), python=str(bare))
    assert done.returncode == 2 and "has no torch" in done.stderr


def test_an_unknown_option_is_refused(tmp_path):
    done = execute("--wheel", str(tmp_path))
    assert done.returncode == 2 and "unknown option --wheel" in done.stderr
