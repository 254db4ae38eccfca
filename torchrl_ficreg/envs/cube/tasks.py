"""Tasks of Cube: the draws of starts and goals, and the success rules."""

from __future__ import annotations

from typing import Literal

import numpy as np

from torchrl_ficreg.envs.cube.physics import CUBE_POSITION, CUBE_ROTATION, CubeArm

SuccessRule = Literal["position", "pose"]

LOW, HIGH = (0.3, -0.3), (0.55, 0.3)  # x and y of the cube and of its target, m
POSITION_TOLERANCE = 0.04  # m, the edge of the cube; published
POSE_POSITION_TOLERANCE = 0.03  # m
POSE_ANGLE_TOLERANCE = np.deg2rad(15.0)


def sample_start(rng: np.random.Generator, arm: CubeArm) -> np.ndarray:
    """Draws a start: the cube anywhere on the table, the gripper above its middle, both at a random yaw.

    Args:
        rng (np.random.Generator): source of randomness.
        arm (CubeArm): used for its inverse kinematics; its simulation is not changed.

    Returns:
        [41] float64.
    """
    position, cube_yaw = rng.uniform(LOW, HIGH), rng.uniform(0, 2 * np.pi)
    return arm.resting(arm_yaw=rng.uniform(-np.pi, np.pi), cube_position=position, cube_yaw=cube_yaw)


def sample_goal(rng: np.random.Generator, state: np.ndarray, arm: CubeArm) -> np.ndarray:
    """Draws a goal: the cube at rest elsewhere, the gripper at its start position with its present yaw.

    Args:
        rng (np.random.Generator): source of randomness.
        state (np.ndarray): [41] float64, where the episode begins.
        arm (CubeArm): used for its inverse kinematics; its simulation is not changed.

    Returns:
        [41] float64.
    """
    position, cube_yaw = rng.uniform(LOW, HIGH), rng.uniform(0, 2 * np.pi)
    arm_yaw = arm.measure(state)["proprio/effector_yaw"].item()
    return arm.resting(arm_yaw=arm_yaw, cube_position=position, cube_yaw=cube_yaw)


def is_success(state: np.ndarray, goal_state: np.ndarray, *, success_on: SuccessRule = "position") -> np.ndarray:
    """Whether the cube is where the goal shows it.

    Args:
        state (np.ndarray): [..., 41].
        goal_state (np.ndarray): [..., 41].
        success_on (str, optional): ``"position"``, the published rule: the centres of the cubes are at most 0.04 m
            apart, at any orientation. ``"pose"``: the centres are at most 0.03 m apart and the orientations differ by
            at most 15 degrees, up to the symmetries of the cube. Default: ``"position"``.

    Returns:
        [...] bool.
    """
    distance = np.linalg.norm(state[..., CUBE_POSITION] - goal_state[..., CUBE_POSITION], axis=-1)
    if success_on == "position":
        return distance <= POSITION_TOLERANCE
    angle = cube_angle(state[..., CUBE_ROTATION], goal_state[..., CUBE_ROTATION])
    return (distance <= POSE_POSITION_TOLERANCE) & (angle <= POSE_ANGLE_TOLERANCE)


def cube_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    r"""The smallest rotation that makes one cube look like another, all faces being alike.

    A cube has 24 rotations onto itself. Up to sign, their quaternions are the 4 axes, the 12 sums of two axes over
    :math:`\sqrt 2` and the 8 sums of all four over 2. With the components of the relative rotation sorted by size,
    :math:`a \ge b \ge c \ge d \ge 0`, the largest overlap with any of them is therefore

    .. math:: \cos(\theta / 2) = \max\bigl(a,\; (a + b) / \sqrt 2,\; (a + b + c + d) / 2\bigr).

    Args:
        first (np.ndarray): [..., 4] unit quaternions, w, x, y, z.
        second (np.ndarray): [..., 4] unit quaternions, w, x, y, z.

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
