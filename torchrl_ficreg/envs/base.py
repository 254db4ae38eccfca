"""The base class of all environments of the package: pictures, restorable states and goals.

The current state and the goal state of a scene are both observed as a picture and as the full simulator state: planners
use the pictures, and an evaluation restores any recorded state exactly.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_ficreg.keys import GOAL_PIXELS, GOAL_STATE, PIXELS, STATE, SUCCESS

DRAW_EVERY = "draw_every"  # reset option
_LARGEST_ACTION = 100.0  # a hundred times the bounds of all environments; larger ones would make states illegal


class PixelGoalEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray], abc.ABC):
    """Base class of goal-conditioned environments with pictures and restorable states.

    Observation: ``pixels`` and ``goal_pixels`` [3, image_size, image_size] uint8, ``state`` and ``goal_state`` [S]
    float64. Reward: 1 when the goal is reached, 0 otherwise. Info: ``success`` [1] bool, at reset too. An episode
    terminates at success if ``terminate_on_success``, and is never truncated here: time limits are set by a wrapper.

    ``reset(options={"state": s, "goal_state": g})`` starts from exactly these states; one that is left out is drawn
    from the task's distribution. With the further option ``"draw_every": k`` the picture of every k-th step of the episode
    is drawn, and the observations between repeat it: for a policy that reads no others.

    A subclass sets ``action_space`` and ``state_space`` before it calls this constructor, and implements seven
    methods: :meth:`_sample_state`, :meth:`_sample_goal`, :meth:`_get_state`, :meth:`_set_state`,
    :meth:`_step_physics`, :meth:`_draw` and :meth:`_is_success`. It may refuse states by :meth:`_why_illegal`, and
    override :meth:`_draw_current` where drawing the simulator's present state needs no restoration.

    Args:
        image_size (int, optional): height and width of the pictures, in pixels. Default: ``64``.
        terminate_on_success (bool, optional): end the episode once the goal is reached. Default: ``True``.
        render_mode (str, optional): ``"rgb_array"``, or None if ``render`` is not used. Default: ``"rgb_array"``.

    Raises:
        ValueError: an argument out of range.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    #: bounds of the action; whether the physics clips to them depends on the environment
    action_space: spaces.Box
    #: bounds of the full simulator state, [S] float64
    state_space: spaces.Box

    def __init__(
        self,
        *,
        image_size: int = 64,
        terminate_on_success: bool = True,
        render_mode: Literal["rgb_array"] | None = "rgb_array",
    ) -> None:
        if not isinstance(image_size, (int, np.integer)) or isinstance(image_size, bool) or image_size < 1:
            raise ValueError(f"image_size must be a positive integer, got {image_size!r}.")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.image_size = int(image_size)
        self.terminate_on_success = terminate_on_success
        self.render_mode = render_mode
        picture = spaces.Box(0, 255, (3, image_size, image_size), np.uint8)
        self.observation_space = spaces.Dict(
            {PIXELS: picture, GOAL_PIXELS: picture, STATE: self.state_space, GOAL_STATE: self.state_space}
        )
        self._goal_state: np.ndarray | None = None
        self._goal_pixels: np.ndarray | None = None
        self._draw_every = 1
        self._steps = 0  # since the reset
        self._last_pixels: np.ndarray | None = None  # which the next observations repeat

    # ------------------------------------------------------------------ the seven methods of a subclass

    @abc.abstractmethod
    def _sample_state(self, rng: np.random.Generator) -> np.ndarray:
        """Draws a start: [S] float64."""

    @abc.abstractmethod
    def _sample_goal(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        """Draws a goal for an episode that begins at ``state`` [S]: [S] float64."""

    @abc.abstractmethod
    def _get_state(self) -> np.ndarray:
        """Returns the full simulator state, [S] float64, as an array that later steps do not change."""

    @abc.abstractmethod
    def _set_state(self, state: np.ndarray) -> None:
        """Restores the simulator to ``state`` [S] such that :meth:`_get_state` returns the same bits."""

    @abc.abstractmethod
    def _step_physics(self, action: np.ndarray) -> None:
        """Advances the simulator by one action, [A] float64 and finite."""

    @abc.abstractmethod
    def _draw(self, state: np.ndarray) -> np.ndarray:
        """Draws the scene at ``state`` [S] into a new [3, image_size, image_size] uint8, without changing the simulator."""

    @abc.abstractmethod
    def _is_success(self, state: np.ndarray, goal_state: np.ndarray) -> bool:
        """Whether ``state`` [S] reaches ``goal_state`` [S]."""

    def _draw_current(self) -> np.ndarray:
        """Draws the simulator's present state into a new [3, image_size, image_size] uint8."""
        return self._draw(self._get_state())

    def _why_illegal(self, state: np.ndarray) -> str | None:
        """The reason why an episode cannot start or end at ``state`` [S], or None; checks the bounds by default."""
        if np.all(state >= self.state_space.low) and np.all(state <= self.state_space.high):
            return None
        return f"it leaves the bounds {self.state_space.low.tolist()} to {self.state_space.high.tolist()}"

    # ------------------------------------------------------------------ the Gymnasium interface

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Starts an episode.

        Args:
            seed (int, optional): seeds the draws of this and of the following resets. Default: ``None``.
            options (dict, optional): ``"state"`` and ``"goal_state"``, [S] each, to start from and to reach; restored
                bit for bit when float64. ``"draw_every"``, int, see the class; 1 if left out. Default: ``None``.

        Returns:
            observation and info, see the class.

        Raises:
            ValueError: unknown options, a state of the wrong shape, not finite or not legal, or ``"draw_every"`` below 1.
        """
        options = {} if options is None else options
        unknown = set(options) - {STATE, GOAL_STATE, DRAW_EVERY}
        if unknown:
            raise ValueError(
                f"unknown reset options {sorted(unknown)}: use {STATE!r} and {GOAL_STATE!r}, and {DRAW_EVERY!r}."
            )
        # Checked before anything changes, so that a refused reset leaves the running episode intact.
        given = {key: self.check_state(key, options[key]) for key in options if key != DRAW_EVERY}
        draw_every = options.get(DRAW_EVERY, 1)
        if not isinstance(draw_every, (int, np.integer)) or isinstance(draw_every, bool) or draw_every < 1:
            raise ValueError(f"option {DRAW_EVERY!r} must be a positive integer, got {draw_every!r}.")
        super().reset(seed=int(seed) if isinstance(seed, np.integer) else seed)
        state = given[STATE] if STATE in given else self._sample_state(self.np_random)
        goal = given[GOAL_STATE] if GOAL_STATE in given else self._sample_goal(self.np_random, state)
        self._set_state(state)
        self._draw_every, self._steps = draw_every, 0
        self._goal_state = goal
        self._goal_pixels = self._draw(goal)  # drawn once per episode
        return self._observe(), self._info(self._is_success(self._get_state(), goal))

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, np.ndarray]]:
        """Takes one action.

        Args:
            action (np.ndarray): [A], finite and within +-100; actions beyond the bounds are passed to the physics.

        Returns:
            observation, reward, terminated, truncated (always False) and info, see the class.

        Raises:
            ValueError: a wrong shape, or a value that is not finite or beyond +-100.
            gymnasium.error.ResetNeeded: no episode was started.
        """
        if self._goal_state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step().")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must be {self.action_space.shape}, got {action.shape}: step takes one action.")
        if not np.isfinite(action).all():
            raise ValueError(f"action must be finite, got {action.tolist()}: look for a NaN in the policy.")
        if np.abs(action).max() > _LARGEST_ACTION:
            raise ValueError(
                f"action must be within +-{_LARGEST_ACTION:.0f}, got {action.tolist()}: the bounds are "
                f"{self.action_space.low.tolist()} to {self.action_space.high.tolist()}, in environment units."
            )
        self._step_physics(action)
        self._steps += 1
        success = self._is_success(self._get_state(), self._goal_state)
        terminated = success and self.terminate_on_success
        return self._observe(), float(success), terminated, False, self._info(success)

    def check_state(self, name: str, value: Any) -> np.ndarray:
        """Checks a start or goal state; the environment is not changed.

        Args:
            name (str): name of the state in messages.
            value (array-like): [S].

        Returns:
            the state, [S] float64, a copy.

        Raises:
            ValueError: a wrong shape, not finite, or not legal.
        """
        state = np.array(value, dtype=np.float64)  # a copy: the caller may write to its array
        if state.shape != self.state_space.shape:
            raise ValueError(f"option {name!r} must have shape {self.state_space.shape}, got {state.shape}.")
        if not np.isfinite(state).all():
            raise ValueError(f"option {name!r} must be finite, got {state.tolist()}.")
        reason = self._why_illegal(state)
        if reason is not None:
            raise ValueError(f"option {name!r} {state.tolist()} is not legal: {reason}.")
        return state

    def render(self) -> np.ndarray | None:
        """Draws the scene with the channels last, for videos.

        Returns:
            [image_size, image_size, 3] uint8, or None without a render mode.
        """
        if self.render_mode is None:
            return None
        return np.ascontiguousarray(self._draw_current().transpose(1, 2, 0))

    # ------------------------------------------------------------------ internals

    def _observe(self) -> dict[str, np.ndarray]:
        # Copies: a caller may write into an observation without changing the next one.
        if self._draw_every == 1:
            pixels = self._draw_current()
        else:
            if self._steps % self._draw_every == 0:
                self._last_pixels = self._draw_current()
            pixels = self._last_pixels.copy()
        return {
            PIXELS: pixels,
            GOAL_PIXELS: self._goal_pixels.copy(),
            STATE: self._get_state(),
            GOAL_STATE: self._goal_state.copy(),
        }

    @staticmethod
    def _info(success: bool) -> dict[str, np.ndarray]:
        return {SUCCESS: np.array([success])}  # an array: TorchRL's info reader takes no Python scalar
