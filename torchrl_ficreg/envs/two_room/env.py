"""The environment TwoRoom: a disc moves through a door to a goal in the other room."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import torch
from gymnasium import spaces

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.two_room import physics, tasks
from torchrl_ficreg.envs.two_room.physics import Collision, TWO_ROOM, TwoRoomGeometry
from torchrl_ficreg.envs.two_room.render import render_pixels


class TwoRoomEnv(PixelGoalEnv):
    """The two-room navigation task as a Gymnasium environment.

    State: x and y of the agent in pixels of the 224 x 224 canvas. Action: [2] in [-1, 1], 5 px per unit and axis;
    larger ones are clipped. Success: less than 16 px from the goal. Resets draw a start and, in the opposite room,
    a goal at least 25 full-speed steps away.

    Args:
        collision (str, optional): the wall rule, ``"swept"``, or ``"endpoint"`` for the published one; see
            :func:`torchrl_ficreg.envs.two_room.physics.step`. Default: ``"swept"``.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.
        **kwargs: see :class:`torchrl_ficreg.envs.base.PixelGoalEnv`.

    Raises:
        ValueError: an argument out of range.

    Examples:
        >>> env = TwoRoomEnv(image_size=64)
        >>> observation, info = env.reset(options={"state": [60.0, 112.0], "goal_state": [164.0, 112.0]})
        >>> observation["pixels"].shape, observation["state"].tolist(), info["success"].tolist()
        ((3, 64, 64), [60.0, 112.0], [False])
        >>> env.step(np.array([1.0, 0.0]))[0]["state"].tolist()
        [65.0, 112.0]
    """

    def __init__(
        self, *, collision: Collision = "swept", geometry: TwoRoomGeometry = TWO_ROOM, **kwargs: Any
    ) -> None:
        if collision not in get_args(Collision):
            raise ValueError(f"collision must be one of {get_args(Collision)}, got {collision!r}.")
        self.collision = collision
        self.geometry = geometry
        # Spaces hold their own random state: one per environment, never the one of the class.
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.state_space = spaces.Box(0.0, float(geometry.canvas), (2,), np.float64)
        super().__init__(**kwargs)
        self._position = torch.full((2,), torch.nan, dtype=torch.float64)

    def _sample_state(self, rng: np.random.Generator) -> np.ndarray:
        return tasks.sample_start(rng, geometry=self.geometry)

    def _sample_goal(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        return tasks.sample_goal(rng, state, geometry=self.geometry)

    def _get_state(self) -> np.ndarray:
        return self._position.numpy().copy()

    def _set_state(self, state: np.ndarray) -> None:
        self._position = torch.from_numpy(state.copy())

    def _step_physics(self, action: np.ndarray) -> None:
        self._position = physics.step(
            self._position, torch.from_numpy(action), geometry=self.geometry, collision=self.collision
        )

    def _draw(self, state: np.ndarray) -> np.ndarray:
        return render_pixels(torch.from_numpy(state), size=self.image_size, geometry=self.geometry).numpy()

    def _is_success(self, state: np.ndarray, goal_state: np.ndarray) -> bool:
        return bool(tasks.is_success(torch.from_numpy(state), torch.from_numpy(goal_state), geometry=self.geometry))

    def _why_illegal(self, state: np.ndarray) -> str | None:
        if physics.is_legal(torch.from_numpy(state), geometry=self.geometry):
            return None
        low, high = self.geometry.border, self.geometry.canvas - self.geometry.border
        return f"it is inside the wall, or x or y leaves [{low}, {high}]"
