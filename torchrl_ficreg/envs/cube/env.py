"""The environment Cube: a robot arm moves a cube to another place."""

from __future__ import annotations

from typing import Any, ClassVar, get_args

import numpy as np
from gymnasium import spaces

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.cube import tasks
from torchrl_ficreg.envs.cube.physics import CUBE_POSITION, CUBE_ROTATION, CubeArm, STATE_SIZE
from torchrl_ficreg.envs.cube.render import check_detail, Detail, render_pixels
from torchrl_ficreg.envs.cube.tasks import SuccessRule

_UNIT_SLACK = 1e-3  # of the length of a quaternion: recorded ones may have been stored as float32
_LARGEST = 1e4  # of all positions and velocities, far beyond what the arm can do
_FARTHEST = 2.0  # m from the foot of the arm, beyond anything it could throw a cube to


class CubeEnv(PixelGoalEnv):
    """OGBench's single cube as a goal-conditioned Gymnasium environment: UR5e arm, two-finger gripper, one red cube.

    State: MuJoCo's 21 positions and 20 velocities, laid out in :mod:`torchrl_ficreg.envs.cube.physics`. Action: [5] in
    [-1, 1], shifts of the gripper by 0.05 m, a rotation by 0.3 rad and a change of its opening by 1 per unit, see
    :class:`~torchrl_ficreg.envs.cube.physics.CubeArm`; larger actions are not clipped, as published. One step lasts
    0.05 s. Starts and goals have the cube anywhere in [0.3, 0.55] x [-0.3, 0.3] m at a random yaw, at rest, and the open
    gripper 0.275 m above the middle of the table.

    Args:
        success_on (str, optional): ``"position"``, the published rule, or ``"pose"``; see
            :func:`torchrl_ficreg.envs.cube.tasks.is_success`. Default: ``"position"``.
        detail (str, optional): of the pictures, ``"fast"``, ``"pixel"`` or ``"published"``; see
            :func:`torchrl_ficreg.envs.cube.render.render_pixels`. Default: ``"pixel"``.
        **kwargs: see :class:`torchrl_ficreg.envs.base.PixelGoalEnv`.

    Attributes:
        arm: the simulator.

    Raises:
        ValueError: an argument out of range.
        ImportError: MuJoCo or ogbench is not installed.

    Examples:
        >>> env = CubeEnv(image_size=64)
        >>> env.action_space.shape, env.state_space.shape
        ((5,), (41,))
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self, *, success_on: SuccessRule = "position", detail: Detail = "pixel", **kwargs: Any
    ) -> None:
        if success_on not in get_args(SuccessRule):
            raise ValueError(f"success_on must be one of {get_args(SuccessRule)}, got {success_on!r}.")
        check_detail(detail)
        self.success_on = success_on
        self.detail = detail
        self.action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)
        self.state_space = spaces.Box(-np.inf, np.inf, (STATE_SIZE,), np.float64)
        super().__init__(**kwargs)
        self.arm = CubeArm()

    def _sample_state(self, rng: np.random.Generator) -> np.ndarray:
        return tasks.sample_start(rng, self.arm)

    def _sample_goal(self, rng: np.random.Generator, state: np.ndarray) -> np.ndarray:
        return tasks.sample_goal(rng, state, self.arm)

    def _get_state(self) -> np.ndarray:
        return self.arm.state

    def _set_state(self, state: np.ndarray) -> None:
        self.arm.restore(state)

    def _step_physics(self, action: np.ndarray) -> None:
        self.arm.step(action)

    def _draw(self, state: np.ndarray) -> np.ndarray:
        return render_pixels(state, size=self.image_size, detail=self.detail)

    def _is_success(self, state: np.ndarray, goal_state: np.ndarray) -> bool:
        return bool(tasks.is_success(state, goal_state, success_on=self.success_on))

    def _why_illegal(self, state: np.ndarray) -> str | None:
        length = np.linalg.norm(state[CUBE_ROTATION])
        if abs(length - 1) > _UNIT_SLACK:
            return (
                f"numbers 17 to 20 are the quaternion of the cube, of length 1, but have length {length:.3g}: "
                "a state is qpos [21] followed by qvel [20]"
            )
        if np.abs(state).max() > _LARGEST:
            return f"a number is beyond {_LARGEST:.0f}, where MuJoCo would reset the simulation"
        position = state[CUBE_POSITION]
        if position[2] < 0 or np.abs(position).max() > _FARTHEST:
            return f"the cube is below the floor or more than {_FARTHEST} m away, at {position.tolist()}"
        return None
