"""Physics of Cube: the UR5e arm and its cube, simulated and controlled by the ``ogbench`` package.

The model takes seconds to compile, so a process compiles it once, and each :class:`CubeArm` has its own MuJoCo data.

A step is a pure function of state and action. The published step is one up to rounding, with a hidden dependence:
MuJoCo's body poses remain those at the beginning of the last substep, and the controller reads the pose of the gripper
from them, 2 ms late. That late pose is recomputed from the state, because the integrator moves positions by the new
velocities and moving them back by the same velocities restores it. The remaining difference is the solver's initial
guess, which the published step carries over and which is zero here.
"""

from __future__ import annotations

import copy
import functools
from typing import Any, TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._gl import how_to_install, import_mujoco

if TYPE_CHECKING:
    import mujoco

NUM_POSITIONS = 21  # MuJoCo's qpos
NUM_VELOCITIES = 20  # MuJoCo's qvel: a rotation has four coordinates and three velocities
STATE_SIZE = NUM_POSITIONS + NUM_VELOCITIES

ARM = slice(0, 6)  # joint angles, rad
GRIPPER = slice(6, 14)  # angles of its linkage, rad
CUBE_POSITION = slice(14, 17)  # centre, m
CUBE_ROTATION = slice(17, 21)  # unit quaternion w, x, y, z

START_POSITION = np.array([0.425, 0.0, 0.275])  # of the gripper at the beginning of an episode, m
CUBE_HEIGHT = 0.02  # of the centre of a cube that lies on the floor, m
TIME_STEP = 0.05  # of one action, s
PURPLE = (0.61, 0.28, 0.82)  # of the gripper


@functools.cache
def compiled() -> Any:
    """Builds OGBench's single cube and compiles its two models, once per process.

    Returns:
        ``ogbench.manipspace.envs.cube_env.CubeEnv``, a template that is copied and never stepped.

    Raises:
        ImportError: MuJoCo or ogbench is not installed.
    """
    import_mujoco()  # before ogbench imports it: chooses the GL library
    try:
        from ogbench.manipspace.envs.cube_env import CubeEnv
    except ImportError as error:
        raise ImportError(f"ogbench is not installed ({error}): {how_to_install('ogbench')}.") from error
    env = CubeEnv("single", ob_type="states", mode="data_collection", visualize_info=False)
    env.reset(seed=0)  # compiles, and makes the marker of the target transparent
    for material in ("ur5e/robotiq/black", "ur5e/robotiq/pad_gray"):
        env.model.material(material).rgba[:3] = PURPLE
    return env


class CubeArm:
    """The simulator behind :class:`~torchrl_ficreg.envs.cube.env.CubeEnv`, without goals and pictures.

    An action is five numbers: shifts of the gripper along x, y and z by 0.05 m per unit, a rotation by 0.3 rad per unit
    and a change of its opening by 1 per unit (positive closes). They are relative to the measured pose and not clipped;
    the resulting target pose is clipped to the workspace, x in [0.25, 0.6], y in [-0.35, 0.35] and z in [0.02, 0.35] m.

    Attributes:
        model: the ``mujoco.MjModel``, shared by all arms of the process: do not write to it.
        ogbench: the environment of the ``ogbench`` package that controls this arm.

    Raises:
        ImportError: MuJoCo or ogbench is not installed.

    Examples:
        >>> arm = CubeArm()
        >>> arm.restore(arm.resting(arm_yaw=0.0, cube_position=[0.4, 0.1], cube_yaw=0.0))
        >>> before = arm.measure(arm.state)["proprio/effector_pos"]
        >>> arm.step(np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
        >>> bool(arm.measure(arm.state)["proprio/effector_pos"][0] > before[0])
        True
    """

    def __init__(self) -> None:
        self._mujoco = import_mujoco()
        template = compiled()
        self.model: mujoco.MjModel = template.model
        self._data = self._mujoco.MjData(self.model)
        self._probe = self._mujoco.MjData(self.model)  # for :meth:`measure`, which does not change the simulation
        # A shallow copy shares the models and constants; what a step writes to is replaced.
        self.ogbench = copy.copy(template)
        self.ogbench._data = self._data
        self.ogbench._ik = type(template._ik)(model=template._ik._model, sites=["attachment_site"])

    def __getstate__(self) -> np.ndarray:
        return self.state  # together with the action it determines every further step

    def __setstate__(self, state: np.ndarray) -> None:
        self.__init__()
        self.restore(state)

    @property
    def state(self) -> np.ndarray:
        """The present state, a new [41] float64."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def restore(self, state: np.ndarray) -> None:
        """Restores a state without a physics step.

        Args:
            state (np.ndarray): [41] float64.
        """
        self._mujoco.mj_resetData(self.model, self._data)  # also clears the "bad state" of a simulation that diverged
        self._data.qpos[:] = state[:NUM_POSITIONS]
        self._data.qvel[:] = state[NUM_POSITIONS:]

    def step(self, action: np.ndarray) -> None:
        """Applies one action for 0.05 s, 25 substeps.

        Args:
            action (np.ndarray): [5] float64.
        """
        positions = self._data.qpos.copy()
        self._late_kinematics(self._data, positions, self._data.qvel)
        self._data.qpos[:] = positions
        self.ogbench.set_control(action)
        self._data.qacc_warmstart[:] = 0.0
        self._mujoco.mj_step(self.model, self._data, nstep=self.ogbench._n_steps)

    def resting(self, *, arm_yaw: float, cube_position: np.ndarray, cube_yaw: float) -> np.ndarray:
        """Builds a state at rest: the open gripper at its start position, the cube on the floor.

        Args:
            arm_yaw (float): yaw of the gripper, in rad.
            cube_position (np.ndarray): [2], x and y of the centre, in m.
            cube_yaw (float): yaw of the cube, in rad.

        Returns:
            [41] float64.
        """
        from ogbench.manipspace import lie

        ours = self.ogbench
        pinch = lie.SE3.from_rotation_and_translation(
            lie.SO3.from_z_radians(arm_yaw) @ ours._effector_down_rotation, START_POSITION
        )
        flange = pinch @ ours._T_pa
        state = np.zeros(STATE_SIZE)
        state[:NUM_POSITIONS] = self.model.qpos0
        state[ARM] = ours._ik.solve(
            pos=flange.translation(), quat=flange.rotation().wxyz, curr_qpos=ours._home_qpos
        )
        state[CUBE_POSITION] = (*cube_position, CUBE_HEIGHT)
        state[CUBE_ROTATION] = yaw_rotation(cube_yaw)
        return state

    def measure(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Computes the observations of OGBench's experts at a state, under OGBench's names.

        Args:
            state (np.ndarray): [41] float64.

        Returns:
            ``proprio/effector_pos`` [3] in m and ``proprio/effector_yaw`` [1] in rad, one substep late as in the
            controller; ``proprio/gripper_opening`` [1] from 0, open, to 1; ``privileged/block_0_pos`` [3] in m and
            ``privileged/block_0_yaw`` [1] in rad.
        """
        from ogbench.manipspace import lie

        positions = state[:NUM_POSITIONS]
        self._late_kinematics(self._probe, positions, state[NUM_POSITIONS:])
        pinch = self.ogbench._pinch_site_id
        turn = lie.SO3.from_matrix(self._probe.site_xmat[pinch].reshape(3, 3))
        opening = np.clip(positions[[self.ogbench._gripper_opening_joint_id]] / 0.8, 0.0, 1.0)
        return {
            "proprio/effector_pos": self._probe.site_xpos[pinch].copy(),
            "proprio/effector_yaw": np.array([turn.compute_yaw_radians()]),
            "proprio/gripper_opening": opening,
            "privileged/block_0_pos": positions[CUBE_POSITION].copy(),
            "privileged/block_0_yaw": np.array([lie.SO3(wxyz=positions[CUBE_ROTATION]).compute_yaw_radians()]),
        }

    def _late_kinematics(self, data: mujoco.MjData, positions: np.ndarray, velocities: np.ndarray) -> None:
        """Computes the body poses one substep earlier, which MuJoCo still holds after a published step."""
        data.qpos[:] = positions
        self._mujoco.mj_integratePos(self.model, data.qpos, velocities, -self.model.opt.timestep)
        self._mujoco.mj_kinematics(self.model, data)


def yaw_rotation(yaw: float) -> np.ndarray:
    """The quaternion of a rotation about the vertical axis.

    Args:
        yaw (float): in rad.

    Returns:
        [4] float64, w, x, y, z.

    Examples:
        >>> yaw_rotation(np.pi).round(3).tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
