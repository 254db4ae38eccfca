"""The table of environments: an entry names an environment, its Gymnasium id and its expert.

A new environment is a folder with a :class:`~torchrl_ficreg.envs.base.PixelGoalEnv` and an :class:`Expert`, and an entry
here. Entries hold places as strings, so that nothing is imported before it is used.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np

from torchrl_ficreg.envs.base import PixelGoalEnv


class Expert(Protocol):
    """A policy that records data from the full state and the goal state.

    A new expert is built for each episode, by ``expert(rng=generator, env=env, **expert_kwargs)``. It draws all its
    random numbers from ``rng``, a ``np.random.Generator``, and may keep a memory between the steps of the episode. It
    may read the scene of ``env``, an :class:`~torchrl_ficreg.envs.base.PixelGoalEnv`, and must not step or reset it. It
    must not modify the arrays it is given.

    Examples:
        >>> class Noise:
        ...     def __init__(self, *, rng, env, std=1.0):
        ...         self.rng, self.size, self.std = rng, env.action_space.shape, std
        ...     def __call__(self, state, goal_state):
        ...         return self.rng.normal(0.0, self.std, self.size).clip(-1, 1).astype(np.float32)
    """

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state (np.ndarray): [S] float64.
            goal_state (np.ndarray): [S] float64.

        Returns:
            [A] float32, in environment units.
        """


@dataclass(frozen=True)
class EnvEntry:
    """The parts of one environment; places are written ``"module:attribute"``.

    Attributes:
        gym_id: the Gymnasium id.
        entry_point: place of the :class:`~torchrl_ficreg.envs.base.PixelGoalEnv` subclass.
        expert: place of the :class:`Expert` that records its data.
        max_episode_steps: time limit of ``gymnasium.make(gym_id)``, in steps.
    """

    gym_id: str
    entry_point: str
    expert: str
    max_episode_steps: int

    def load_env(self) -> type[PixelGoalEnv]:
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
    """Finds the entry of an environment of this package.

    Args:
        name (str): short name or Gymnasium id.

    Returns:
        the entry.

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
