"""Which starts and goals an episode of the cube is made of."""

from __future__ import annotations

import numpy as np

from torchrl_ficreg.envs.cube.physics import CUBE_POSITION, CUBE_ROTATION, CubeArm


POSITION_TOLERANCE = 0.04  # m, the edge of the cube; published
POSE_POSITION_TOLERANCE = 0.03  # m
POSE_ANGLE_TOLERANCE = np.deg2rad(15.0)


def cube_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    r"""The smallest turn that makes one cube look like another, whose faces are all alike.

    A cube has 24 rotations onto itself. Up to sign, their quaternions are the 4 axes, the 12 sums of two axes over
    :math:`\sqrt 2` and the 8 sums of all four over 2. With the components of the relative rotation sorted by size,
    :math:`a \ge b \ge c \ge d \ge 0`, the largest overlap with any of them is therefore

    .. math:: \cos(\theta / 2) = \max\bigl(a,\; (a + b) / \sqrt 2,\; (a + b + c + d) / 2\bigr).

    Args:
        first: [..., 4] unit quaternions, w, x, y, z.
        second: [..., 4] likewise.

    Returns:
        [...] float64 in rad, at most 62.8 degrees.

    Examples:
        >>> from torchrl_ficreg.envs.cube.physics import yaw_rotation
        >>> upright = np.array([1.0, 0.0, 0.0, 0.0])
        >>> np.rad2deg([cube_angle(upright, yaw_rotation(np.deg2rad(yaw))) for yaw in (10, 80, 90)]).round(3).tolist()
        [10.0, 10.0, 0.0]
    """
    w, x, y, z = np.moveaxis(np.asarray(first, dtype=np.float64), -1, 0)
    # The conjugate of the first times the second, as four dot products with the second.
    rows = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])  # [4, 4, ...]
    relative = np.einsum("ij...,...j->...i", rows, np.asarray(second, dtype=np.float64))  # [..., 4]
    parts = np.sort(np.abs(relative), axis=-1)[..., ::-1]  # [..., 4]
    sums = parts.cumsum(-1)  # [..., 4]
    overlap = np.maximum(np.maximum(sums[..., 0], sums[..., 1] / np.sqrt(2)), sums[..., 3] / 2)  # [...]
    return 2 * np.arccos(np.minimum(overlap, 1.0))


def position_reached(state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
    """The published rule: the centres of the cubes are at most 0.04 m apart, however the cubes are turned.

    Args:
        state: [..., 41].
        goal_state: [..., 41].

    Returns:
        [...] bool.
    """
    return _distance(state, goal_state) <= POSITION_TOLERANCE


def pose_reached(state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
    """The stricter rule: centres at most 0.03 m apart, and at most 15 degrees between the cubes, symmetries aside.

    Args:
        state: [..., 41].
        goal_state: [..., 41].

    Returns:
        [...] bool.
    """
    near = _distance(state, goal_state) <= POSE_POSITION_TOLERANCE
    return near & (cube_angle(state[..., CUBE_ROTATION], goal_state[..., CUBE_ROTATION]) <= POSE_ANGLE_TOLERANCE)


def _distance(state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
    return np.linalg.norm(state[..., CUBE_POSITION] - goal_state[..., CUBE_POSITION], axis=-1)


LOW, HIGH = (0.3, -0.3), (0.55, 0.3)  # x and y of the cube and of its target, m


def sample_start(rng: np.random.Generator, arm: CubeArm) -> np.ndarray:
    """Draws a start: the cube anywhere on the table, the gripper above its middle, both turned at random.

    Args:
        rng: the source of randomness.
        arm: which knows the joint angles of a pose.

    Returns:
        [41] float64.
    """
    position, cube_yaw = rng.uniform(LOW, HIGH), rng.uniform(0, 2 * np.pi)
    return arm.resting(arm_yaw=rng.uniform(-np.pi, np.pi), cube_position=position, cube_yaw=cube_yaw)


def sample_goal(rng: np.random.Generator, state: np.ndarray, arm: CubeArm) -> np.ndarray:
    """Draws a goal: the cube at rest elsewhere, the gripper back at its start position, turned as it is now.

    Args:
        rng: the source of randomness.
        state: [41] float64, where the episode begins.
        arm: which knows the joint angles of a pose.

    Returns:
        [41] float64.
    """
    position, cube_yaw = rng.uniform(LOW, HIGH), rng.uniform(0, 2 * np.pi)
    arm_yaw = arm.measure(state)["proprio/effector_yaw"].item()
    return arm.resting(arm_yaw=arm_yaw, cube_position=position, cube_yaw=cube_yaw)
