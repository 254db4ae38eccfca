"""Episodes whose every number says which episode and step it belongs to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from torchrl_ficreg.data import EpisodeWriter

META = {"env": "two_room", "env_kwargs": {"noise": 1.0}, "image_size": 4, "seed": 0}


def _episode(number: int, length: int = 20, size: int = 4) -> dict[str, np.ndarray]:
    step = np.arange(length)
    pixels = np.zeros((length, 3, size, size), np.uint8)
    pixels[:, 0], pixels[:, 1] = number, step[:, None, None]
    action = np.stack([np.full(length, number), step, -step**2 / 7], axis=1).astype(np.float32)
    action[-1] = 0
    return {"pixels": pixels, "action": action, "state": np.stack([np.full(length, number), step], 1).astype(float)}


@pytest.fixture
def make_episode() -> Callable[..., dict[str, np.ndarray]]:
    """``make_episode(number, length)`` has pixels (number, step, 0) and state (number, step)."""
    return _episode


@pytest.fixture
def meta() -> dict:
    """What a collection notes about itself."""
    return {**META, "env_kwargs": dict(META["env_kwargs"])}


@pytest.fixture(scope="session")
def record(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """``record(lengths, target)`` writes one episode per length and returns a new directory."""

    def record(lengths: list[int], target: int | None = None, frames: str = "raw") -> Path:
        path = tmp_path_factory.mktemp("recorded")
        with EpisodeWriter(path, target_episodes=target or len(lengths), meta=META, frames=frames) as writer:
            for number, length in enumerate(lengths, start=1):
                writer.append(_episode(number, length))
        return path

    return record
