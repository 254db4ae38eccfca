"""Which starts and goals an episode of the cube is made of."""

from __future__ import annotations

import numpy as np

from torchrl_ficreg.envs.cube.arm import CubeArm

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
