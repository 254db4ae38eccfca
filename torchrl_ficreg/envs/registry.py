"""The table of environments. One more environment is one more entry here; nothing is imported until it is used."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np

from torchrl_ficreg.envs.base import GoalEnv


class Expert(Protocol):
    """A policy that records data: it sees the full state and the goal, and keeps what it remembers to itself."""

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state: [S] float64.
            goal_state: [S] float64.

        Returns:
            [A] float32.
        """


@dataclass(frozen=True)
class EnvEntry:
    """Where to find the parts of one environment; places are written ``"module:attribute"``.

    Attributes:
        gym_id: its Gymnasium id.
        entry_point: the :class:`~torchrl_ficreg.envs.base.GoalEnv` subclass.
        expert: the :class:`Expert` that records its data, built anew for each episode as ``expert(rng=generator,
            env=env, **expert_kwargs)``; the environment is there to be asked about its scene, not to be stepped.
        max_episode_steps: the time limit of ``gymnasium.make(gym_id)``.
    """

    gym_id: str
    entry_point: str
    expert: str
    max_episode_steps: int

    def load_env(self) -> type[GoalEnv]:
        """Imports the environment class."""
        return _load(self.entry_point)

    def load_expert(self) -> Callable[..., Expert]:
        """Imports the expert class."""
        return _load(self.expert)


def _load(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


ENVIRONMENTS: dict[str, EnvEntry] = {
    "two_room": EnvEntry(
        gym_id="torchrl_ficreg/TwoRoom-v0",
        entry_point="torchrl_ficreg.envs.two_room.env:TwoRoomEnv",
        expert="torchrl_ficreg.envs.two_room.expert:TwoRoomExpert",
        max_episode_steps=100,
    ),
    "push_t": EnvEntry(
        gym_id="torchrl_ficreg/PushT-v0",
        entry_point="torchrl_ficreg.envs.push_t.env:PushTEnv",
        expert="torchrl_ficreg.envs.push_t.expert:PushTExpert",
        max_episode_steps=200,
    ),
    "reacher": EnvEntry(
        gym_id="torchrl_ficreg/Reacher-v0",
        entry_point="torchrl_ficreg.envs.reacher.env:ReacherEnv",
        expert="torchrl_ficreg.envs.reacher.expert:ReacherExpert",
        max_episode_steps=200,
    ),
    "cube": EnvEntry(
        gym_id="torchrl_ficreg/Cube-v0",
        entry_point="torchrl_ficreg.envs.cube.env:CubeEnv",
        expert="torchrl_ficreg.envs.cube.expert:CubeExpert",
        max_episode_steps=200,
    ),
}


def find_entry(name: str) -> EnvEntry:
    """Looks an environment of this package up.

    Args:
        name: its short name or its Gymnasium id.

    Returns:
        its entry.

    Raises:
        ValueError: no such environment.

    Examples:
        >>> find_entry("two_room").gym_id
        'torchrl_ficreg/TwoRoom-v0'
    """
    for short, entry in ENVIRONMENTS.items():
        if name in (short, entry.gym_id):
            return entry
    raise ValueError(f"unknown environment {name!r}: choose one of {sorted(ENVIRONMENTS)} or its Gymnasium id.")


def register_all() -> None:
    """Registers every environment of the package with Gymnasium; a second call changes nothing."""
    for entry in ENVIRONMENTS.values():
        if entry.gym_id not in gymnasium.registry:
            gymnasium.register(entry.gym_id, entry.entry_point, max_episode_steps=entry.max_episode_steps)
