"""What the 41 numbers of a state mean, and when two cubes lie alike."""

from __future__ import annotations

import numpy as np

NUM_POSITIONS = 21  # MuJoCo's qpos
NUM_VELOCITIES = 20  # MuJoCo's qvel: a rotation has four coordinates and three velocities
STATE_SIZE = NUM_POSITIONS + NUM_VELOCITIES

ARM = slice(0, 6)  # joint angles, rad
GRIPPER = slice(6, 14)  # angles of its linkage, rad
CUBE_POSITION = slice(14, 17)  # centre, m
CUBE_ROTATION = slice(17, 21)  # unit quaternion w, x, y, z

POSITION_TOLERANCE = 0.04  # m, the edge of the cube; published
POSE_POSITION_TOLERANCE = 0.03  # m
POSE_ANGLE_TOLERANCE = np.deg2rad(15.0)


def yaw_rotation(yaw: float) -> np.ndarray:
    """Writes a turn about the vertical axis as a quaternion.

    Args:
        yaw: rad.

    Returns:
        [4] float64, w, x, y, z.

    Examples:
        >>> yaw_rotation(np.pi).round(3).tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


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
