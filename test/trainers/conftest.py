"""Fixtures of the trainer's tests: one finished run, and the warnings of a test."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tiny import make_trainer, same, weights
from torchrl import torchrl_logger

from torchrl_ficreg.trainers import OfflineTrainer


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> tuple[Path, OfflineTrainer]:
    """Folder of a run that was not interrupted, and its trainer, after 27 steps."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    trainer = make_trainer(run_dir)
    trainer.train()
    return run_dir, trainer


@pytest.fixture(scope="session")
def unbroken(finished) -> dict[str, torch.Tensor]:
    """Weights of a run that was not interrupted."""
    return weights(finished[1])


@pytest.fixture
def continue_run(unbroken) -> Callable[..., OfflineTrainer]:
    """``continue_run(run_dir, 9)`` resumes at step 9 and ends with the weights of a run that was not interrupted."""

    def continue_run(run_dir: Path, step: int, start: Path | None = None, **settings) -> OfflineTrainer:
        trainer = make_trainer(run_dir, **settings)
        torch.manual_seed(123)  # dropout must not depend on what the new process drew
        assert trainer.resume(start) and trainer.step == step
        trainer.train()
        assert same(weights(trainer), unbroken)
        return trainer

    return continue_run


@pytest.fixture
def run_dir(finished, tmp_path) -> Path:
    """A copy of the folder of the finished run, with checkpoints of steps 18 and 27."""
    return Path(shutil.copytree(finished[0], tmp_path / "run"))


@pytest.fixture
def warnings(monkeypatch) -> list[str]:
    """The warnings that TorchRL's logger receives."""
    texts = []
    monkeypatch.setattr(torchrl_logger, "warning", lambda text, *_: texts.append(text))
    return texts
