"""Runs the scripts as a user does: in a process of their own, in an empty folder, with overrides that make them tiny."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
PLAN = ["plan.iterations=1", "plan.num_candidates=20", "plan.num_elites=5"]
TINY = [
    "env.data.episodes=20",
    "model.image_size=32",
    "model.conv_channels=[4,8,16]",
    "model.predictor_width=16",
    "model.predictor_depth=1",
    "model.predictor_mlp_dim=16",
    "model.inverse_hidden_dim=16",
    "optim.epochs=1",
    "optim.batch_size=32",
    "collect.num_workers=0",
    "evaluation.num_pairs=4",
    "evaluation.record=2",
    *PLAN,
]


@pytest.fixture(scope="session")
def command() -> Callable[..., list[str]]:
    """``command("train.py", "seed=1")`` is the command line of a tiny run; others get no overrides."""

    def build(script: str, *overrides: str, tiny: bool = True) -> list[str]:
        return [sys.executable, str(SCRIPTS / script), *(TINY if script != "evaluate.py" and tiny else []), *overrides]

    return build


@pytest.fixture(scope="session")
def environment() -> dict[str, str]:
    """One thread, and a logger that stays off the network."""
    quiet = {"WANDB_MODE": "offline", "WANDB_X_SERVICE_WAIT": "120"}  # its service starts slowly on a busy machine
    return {**os.environ, "OMP_NUM_THREADS": "1", **quiet}


@pytest.fixture(scope="session")
def execute(command, environment) -> Callable[..., subprocess.CompletedProcess]:
    """``execute(folder, "train.py", "seed=1")`` runs it there; an exit code other than zero is the test's business."""

    def run(folder: Path, script: str, *overrides: str, tiny: bool = True) -> subprocess.CompletedProcess:
        line = command(script, *overrides, tiny=tiny)
        return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=240)

    return run


@pytest.fixture(scope="session")
def files() -> Callable[[Path], dict[str, bytes]]:
    """Every file below a folder, by its relative name."""
    return lambda folder: {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


@pytest.fixture(scope="session")
def trained_once(tmp_path_factory, execute, files) -> tuple[Path, set[str]]:
    """A folder in which train.py ran once with its defaults made tiny, and what it held right afterwards."""
    folder = tmp_path_factory.mktemp("trained")
    done = execute(folder, "train.py")
    assert done.returncode == 0, done.stderr
    assert "ficreg" in done.stdout and "random" in done.stdout
    return folder, set(files(folder))


@pytest.fixture(scope="session")
def trained(trained_once) -> Path:
    """The folder of the trained run, to be read only."""
    return trained_once[0]


@pytest.fixture
def copy(trained, tmp_path) -> Path:
    """A copy of it, to be changed."""
    return Path(shutil.copytree(trained, tmp_path / "copy"))
