"""Environments in tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from simulators import require_simulator

from torchrl_ficreg.envs import ENVIRONMENTS, PixelGoalEnv


@pytest.fixture
def build() -> Callable[..., PixelGoalEnv]:
    """``build(name, **kwargs)`` makes an environment, which is closed after the test; skips without its simulator."""
    made = []

    def build(name: str, **kwargs) -> PixelGoalEnv:
        require_simulator(name)
        made.append(ENVIRONMENTS[name].load_env()(**{"image_size": 16, **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()
