"""Runs the scripts in a folder, with overrides that make them tiny: in this process, or in one of their own."""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import io
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import hydra
import pytest
import torch
from omegaconf import DictConfig

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
sys.path.insert(0, str(SCRIPTS))
PLAN = ["plan.iterations=1", "plan.num_candidates=20", "plan.num_elites=5"]
TINY = ["model.image_size=32", "model.conv_channels=[4,8,16]", "model.predictor_width=16", "model.predictor_depth=1"]
TINY += ["model.predictor_mlp_dim=16", "model.inverse_hidden_dim=16", "optim.epochs=1", "optim.batch_size=32"]
TINY += ["env.data.episodes=20", "collect.num_workers=0", "evaluation.num_pairs=4", "evaluation.record=2", *PLAN]


def with_tiny(script: str, overrides: tuple[str, ...], tiny: bool) -> list[str]:
    return [*(TINY if script in ("train.py", "collect.py") and tiny else []), *overrides]


@pytest.fixture(scope="session")
def command() -> Callable[..., list[str]]:
    """``command("train.py", "seed=1")`` is the command line of a tiny run; others get no overrides."""

    def build(script: str, *overrides: str, tiny: bool = True) -> list[str]:
        return [sys.executable, str(SCRIPTS / script), *with_tiny(script, overrides, tiny)]

    return build


@pytest.fixture(scope="session")
def environment() -> dict[str, str]:
    """One thread, and a logger that stays off the network."""
    quiet = {"WANDB_MODE": "offline", "WANDB_X_SERVICE_WAIT": "120"}  # its service starts slowly on a busy machine
    return {**os.environ, "OMP_NUM_THREADS": "1", **quiet}


@pytest.fixture(scope="session")
def spawn(command, environment) -> Callable[..., subprocess.CompletedProcess]:
    """``spawn(folder, "train.py", "seed=1")`` runs it there in a process of its own, as a user does."""

    def run(folder: Path, script: str, *overrides: str, tiny: bool = True) -> subprocess.CompletedProcess:
        line = command(script, *overrides, tiny=tiny)
        return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)

    return run


@pytest.fixture(scope="session")
def execute() -> Callable[..., subprocess.CompletedProcess]:
    """``execute(folder, "train.py", "seed=1")`` runs it there in this process, which need not import torch again."""

    def run(folder: Path, script: str, *overrides: str, tiny: bool = True) -> subprocess.CompletedProcess:
        line, here, threads = [script, *with_tiny(script, overrides, tiny)], Path.cwd(), torch.get_num_threads()
        out, err = io.StringIO(), io.StringIO()
        main = importlib.import_module(script.removesuffix(".py")).main
        # Hydra composes the configuration twice, first for hydra.mode, which is null.
        quick_start = mock.patch("hydra._internal.hydra.Hydra.get_mode", return_value=None)
        os.chdir(folder)
        torch.set_num_threads(1)
        try:
            with mock.patch.object(sys, "argv", line), mock.patch.dict(os.environ), warnings.catch_warnings(), quick_start:
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                    main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        finally:
            os.chdir(here)
            torch.set_num_threads(threads)
        return subprocess.CompletedProcess(line, code, out.getvalue(), err.getvalue())

    return run


@pytest.fixture
def refused(execute, tmp_path) -> Callable[..., str]:
    """``refused("train.py", "seed=-1")`` is the one line in which a script ends; it runs as the user typed it, or tiny."""

    def run(script: str, *overrides: str, folder: Path = tmp_path, code: int | None = None, tiny: bool = False) -> str:
        done = execute(folder, script, *overrides, tiny=tiny)
        (line,) = done.stderr.splitlines()
        assert line.startswith("error: ") and done.returncode in ((1, 2) if code is None else (code,)), done
        assert not done.stdout
        return line

    return run


@pytest.fixture(scope="session")
def config() -> Callable[..., DictConfig]:
    """``config("train", "seed=1")`` is a composed configuration."""
    importlib.import_module("configs")  # the schemas

    @functools.cache
    def compose(name: str, *overrides: str, **settings: bool) -> DictConfig:
        with hydra.initialize_config_dir(str(SCRIPTS / "config"), version_base="1.3"):
            return hydra.compose(name, list(overrides), **settings)

    return lambda *arguments, **settings: copy.deepcopy(compose(*arguments, **settings))


@pytest.fixture(scope="session")
def files() -> Callable[[Path], dict[str, bytes]]:
    """Every file below a folder, by its relative name."""
    return lambda folder: {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


@pytest.fixture(scope="session")
def trained_once(tmp_path_factory, spawn, files) -> tuple[Path, set[str]]:
    """A folder in which train.py ran once with its defaults made tiny, and what it held right afterwards."""
    folder = tmp_path_factory.mktemp("trained")
    done = spawn(folder, "train.py")
    assert done.returncode == 0, done.stderr
    assert "ficreg" in done.stdout and "random" in done.stdout
    return folder, set(files(folder))


@pytest.fixture(scope="session")
def trained(trained_once) -> Path:
    """The folder of the trained run, to be read only."""
    return trained_once[0]


@pytest.fixture(name="copy")
def copy_of_trained(trained, tmp_path) -> Path:
    """A copy of it, to be changed."""
    return Path(shutil.copytree(trained, tmp_path / "copy"))


@pytest.fixture
def beside(trained, tmp_path) -> Path:
    """An empty folder beside the recorded episodes."""
    (tmp_path / "data").symlink_to(trained / "data")
    return tmp_path
