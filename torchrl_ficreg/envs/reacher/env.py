"""The environment Reacher: dm_control's arm turns its two joints to given angles."""

from __future__ import annotations

from typing import Any, ClassVar, get_args, Literal

import numpy as np
from gymnasium import spaces

from torchrl_ficreg.envs._gl import import_mujoco, MujocoHolder, OffscreenRenderer
from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.reacher import physics, tasks
from torchrl_ficreg.envs.reacher.render import render_pixels

Detail = Literal["fast", "published"]

_LARGEST = 1e4  # of all angles and velocities, far beyond what the motors can do


class ReacherEnv(MujocoHolder, PixelGoalEnv):
    """Turn the two joints of a planar arm by their motors until both angles are those of the goal.

    State: shoulder and wrist in rad, then their velocities in rad/s, [4] float64; the shoulder winds without limit.
    Action: the torques of the two motors in units of 0.05 N m, [2], clipped to +-1; it lasts two control steps of
    0.02 s. Starts and goals are at rest, the shoulder uniform over the circle and the wrist within +-160 degrees.
    Success: each angle within 0.05 rad of its goal, at any velocity. Pictures: from above, without dm_control's target;
    they depend on the angles alone.

    Success is tested after each control step, and the action that first reaches the goal of an episode ends there,
    after one control step if necessary, as in the published environment: the state is then the one that reached the
    goal. Episodes have no time limit here.

    Args:
        wrap (bool, optional): compare the shoulder's angle modulo 2 pi, because a picture does not show full turns.
            False is the published rule, under which an arm may look as in the goal picture without success. Default:
            ``True``.
        stop_within_action (bool, optional): end the action that first reaches the goal as soon as it does. False, for
            recordings, tests success after whole actions only. Default: ``True``.
        detail (str, optional): of the pictures. ``"published"`` is dm_control's scene, drawn by MuJoCo.
            :func:`~torchrl_ficreg.envs.reacher.render.render_pixels` draws ``"fast"`` pictures, without GL and twenty times
            as fast. Start, goal and all frames of a dataset have to be of one kind. Default: ``"published"``.
        shadow_size (int, optional): resolution of the shadow map of published pictures; fast ones have no map. 512
            instead of dm_control's 2048 makes software rendering about twice as fast and changes about 1 in 1000 values
            of a picture. Default: ``2048``.
        **kwargs: of :class:`~torchrl_ficreg.envs.base.PixelGoalEnv`.

    Raises:
        ValueError: an argument out of range.
        ImportError: MuJoCo or dm_control is not installed.

    Examples:
        >>> env = ReacherEnv(image_size=64)
        >>> env.action_space.shape, env.state_space.shape, env.observation_space["pixels"].shape
        ((2,), (4,), (3, 64, 64))
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(
        self,
        *,
        wrap: bool = True,
        stop_within_action: bool = True,
        detail: Detail = "published",
        shadow_size: int = 2048,
        **kwargs: Any,
    ) -> None:
        if detail not in get_args(Detail):
            raise ValueError(f"detail must be one of {get_args(Detail)}, got {detail!r}.")
        if not isinstance(shadow_size, int) or isinstance(shadow_size, bool) or shadow_size < 1:
            raise ValueError(f"shadow_size must be a positive integer, got {shadow_size!r}.")
        self.wrap = wrap
        self.stop_within_action = stop_within_action
        self.detail = detail
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        highest = np.array([np.inf, physics.WRIST_LIMIT + physics.WRIST_SLACK, np.inf, np.inf])
        self.state_space = spaces.Box(-highest, highest, dtype=np.float64)
        super().__init__(**kwargs)
        self._mujoco = import_mujoco()
        self._model = physics.load_model()
        self._data = self._mujoco.MjData(self._model)
        self._renderer: OffscreenRenderer | None = None
        if detail == "published":
            self._model.vis.quality.shadowsize = shadow_size
            self._drawn = self._mujoco.MjData(self._model)  # so that drawing does not change the simulation
            self._renderer = OffscreenRenderer(self._model, self.image_size)
        self._reached = False  # in this episode; the start does not count

    def close(self) -> None:
        """Releases the GL context of published pictures; drawing again opens a new one."""
        if self._renderer is not None:
            self._renderer.close()

    def _sample_state(self, rng: np.random.Generator) -> np.ndarray:
        return tasks.sample_state(rng)

    def _sample_goal(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        return tasks.sample_state(rng)

    def _get_state(self) -> np.ndarray:
        return np.concatenate([self._data.qpos, self._data.qvel])

    def _set_state(self, state: np.ndarray) -> None:
        self._mujoco.mj_resetData(self._model, self._data)  # time, motors and solver state
        self._data.qpos[:] = state[:2]
        self._data.qvel[:] = state[2:]
        self._reached = False

    def _step_physics(self, action: np.ndarray) -> None:
        self._data.ctrl[:] = action
        for _ in range(physics.CONTROL_STEPS):
            self._mujoco.mj_step(self._model, self._data)
            if self.stop_within_action and not self._reached and self._is_success(self._get_state(), self._goal_state):
                self._reached = True
                return

    def _draw(self, state: np.ndarray) -> np.ndarray:
        if self._renderer is None:
            return render_pixels(state, size=self.image_size)
        self._drawn.qpos[:] = state[:2]
        self._mujoco.mj_forward(self._model, self._drawn)
        return self._renderer.draw(self._drawn, physics.CAMERA)

    def _is_success(self, state: np.ndarray, goal_state: np.ndarray) -> bool:
        return bool(tasks.is_success(state, goal_state, wrap=self.wrap))

    def _why_illegal(self, state: np.ndarray) -> str | None:
        limit = physics.WRIST_LIMIT + physics.WRIST_SLACK
        if np.abs(state).max() > _LARGEST:
            return f"a number is beyond {_LARGEST:.0f}, where MuJoCo would reset the simulation"
        if abs(state[1]) <= limit:
            return None
        return f"the wrist's stop at +-{physics.WRIST_LIMIT:.4f} rad never yields beyond +-{limit:.4f} rad"
