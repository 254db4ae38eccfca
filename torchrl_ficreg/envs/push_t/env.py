"""The environment PushT: a disc pushes a T-shaped block to a given position and angle."""

from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np
from gymnasium import spaces

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.push_t import tasks
from torchrl_ficreg.envs.push_t.geometry import STATE_SIZE
from torchrl_ficreg.envs.push_t.physics import PushTWorld
from torchrl_ficreg.envs.push_t.render import render_pixels
from torchrl_ficreg.envs.push_t.tasks import SuccessRule
from torchrl_ficreg.keys import GOAL_STATE, STATE

# The disc passes through walls: 200 steps of full speed, 40.7 px each, from inside the window stay within this.
_FARTHEST = 10_000.0  # px, and px/s
# A recording in float32 may round an angle just below 2 pi up to this.
_LARGEST_ANGLE = float(np.float32(2 * math.pi))


class PushTEnv(PixelGoalEnv):
    """The block-pushing task as a Gymnasium environment.

    State [7]: x and y of the agent, x, y and angle (in [0, 2 pi)) of the block, velocity x and y of the agent, in
    pixels of a 512 x 512 window, radians and px/s. Action [2]: shift of the agent's target in x and y, 100 px per
    unit; actions beyond [-1, 1] are not clipped, as in the published environment. A step lasts 0.1 s. Success: agent
    and block within 20 px of the goal, one distance in four dimensions, and the angle within 20 degrees. Starts and
    goals come from the same distribution, at rest and without overlaps.

    The green T in the pictures is a decoration at a fixed place: the goal of an episode is ``goal_state``.

    Args:
        success_on (str, optional): ``"state"``, or ``"block"`` to leave the agent out; see
            :func:`torchrl_ficreg.envs.push_t.tasks.is_success`. Default: ``"state"``.
        draw_goal (bool, optional): draw the green T. Default: ``True``.
        legacy_restore (bool, optional): reset as the published environment does, which sets the scene to the goal and
            then to the start with a physics step of 0.01 s after each: the episode begins near the start instead of
            at it. Default: ``False``.
        legacy_draws (bool, optional): starts and goals may contain overlaps, as in the published environment. Default:
            ``False``.
        **kwargs: see :class:`torchrl_ficreg.envs.base.PixelGoalEnv`.

    Raises:
        ValueError: an argument out of range.
        ImportError: pymunk is missing.

    Examples:
        >>> env = PushTEnv(image_size=64)
        >>> state = [100.0, 100.0, 300.0, 300.0, 0.0, 0.0, 0.0]
        >>> observation, info = env.reset(options={"state": state, "goal_state": [130.0, *state[1:]]})
        >>> observation["pixels"].shape, info["success"].tolist()
        ((3, 64, 64), [False])
        >>> observation, _, terminated, _, _ = env.step(np.array([1.0, 0.0]))
        >>> observation["state"][:2].round(2).tolist(), terminated
        ([129.57, 100.0], True)
    """

    def __init__(
        self,
        *,
        success_on: SuccessRule = "state",
        draw_goal: bool = True,
        legacy_restore: bool = False,
        legacy_draws: bool = False,
        **kwargs: Any,
    ) -> None:
        if success_on not in get_args(SuccessRule):
            raise ValueError(f"success_on must be one of {get_args(SuccessRule)}, got {success_on!r}.")
        self.success_on = success_on
        self.draw_goal = draw_goal
        self.legacy_restore = legacy_restore
        self.legacy_draws = legacy_draws
        # Spaces hold their own random state: one per environment, never the one of the class.
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        low, high = np.full(STATE_SIZE, -_FARTHEST), np.full(STATE_SIZE, _FARTHEST)
        low[4], high[4] = 0.0, _LARGEST_ANGLE
        self.state_space = spaces.Box(low, high, dtype=np.float64)
        super().__init__(**kwargs)
        self._world = PushTWorld()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Starts an episode, see :meth:`torchrl_ficreg.envs.base.PixelGoalEnv.reset`."""
        observation, info = super().reset(seed=seed, options=options)
        if not self.legacy_restore:
            return observation, info
        start, goal = observation[STATE], observation[GOAL_STATE]
        self._world.set_state(goal)
        self._world.restore_legacy(goal)  # the published reset simulates a step at the goal, which affects the start
        self._world.restore_legacy(start)
        return self._observe(), self._info(self._is_success(self._get_state(), goal))

    def _sample_state(self, rng: np.random.Generator) -> np.ndarray:
        return tasks.sample_state(rng, legacy_draws=self.legacy_draws)

    def _sample_goal(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        return tasks.sample_state(rng, legacy_draws=self.legacy_draws)

    def _get_state(self) -> np.ndarray:
        return self._world.get_state()

    def _set_state(self, state: np.ndarray) -> None:
        self._world.set_state(state)

    def _step_physics(self, action: np.ndarray) -> None:
        self._world.step(action)

    def _draw(self, state: np.ndarray) -> np.ndarray:
        return render_pixels(state, size=self.image_size, draw_goal=self.draw_goal)

    def _is_success(self, state: np.ndarray, goal_state: np.ndarray) -> bool:
        return tasks.is_success(state, goal_state, success_on=self.success_on)

    def _why_illegal(self, state: np.ndarray) -> str | None:
        if not 0 <= state[4] <= _LARGEST_ANGLE:
            return "the angle, state[4], leaves [0, 2 pi): take it modulo 2 pi"
        if np.abs(np.delete(state, 4)).max() > _FARTHEST:
            return f"a coordinate or a velocity leaves [-{_FARTHEST:.0f}, {_FARTHEST:.0f}]"
        return None
