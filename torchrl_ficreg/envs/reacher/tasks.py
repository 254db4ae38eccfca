"""Tasks of Reacher: the draws of starts and goals, and the success rule."""

from __future__ import annotations

import numpy as np

from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.reacher.physics import WRIST_LIMIT

TOLERANCE = 0.05  # rad per joint, within which a goal is reached


def sample_state(rng: np.random.Generator) -> np.ndarray:
    """Draws a start or a goal, at rest: the shoulder uniform over the circle, the wrist uniform within its limits.

    Args:
        rng (np.random.Generator): source of randomness.

    Returns:
        [4] float64.

    Examples:
        >>> sample_state(np.random.default_rng(0)).round(3).tolist()
        [0.861, -1.286, 0.0, 0.0]
    """
    return np.array([rng.uniform(-np.pi, np.pi), rng.uniform(-WRIST_LIMIT, WRIST_LIMIT), 0.0, 0.0])


def joint_error(state: np.ndarray, goal_state: np.ndarray, *, wrap: bool = True) -> np.ndarray:
    """The differences of both joint angles between a goal and a state.

    Args:
        state (np.ndarray): [..., 4] or [..., 2], angles first.
        goal_state (np.ndarray): as ``state``.
        wrap (bool, optional): take the shoulder's shorter direction around the circle; the wrist has stops. Default:
            ``True``.

    Returns:
        [..., 2] float64, goal minus state, in rad.

    Examples:
        >>> joint_error(np.array([3.0, 0.5]), np.array([-3.0, 0.0])).round(3).tolist()
        [0.283, -0.5]
    """
    error = np.array(goal_state[..., :2] - state[..., :2], dtype=np.float64)
    if wrap:
        error[..., 0] = wrap_angle(error[..., 0])
    return error


def is_success(state: np.ndarray, goal_state: np.ndarray, *, wrap: bool = True) -> np.ndarray:
    """Whether each joint angle is within 0.05 rad of its goal; velocities are ignored.

    Args:
        state (np.ndarray): [..., 4] or [..., 2], angles first.
        goal_state (np.ndarray): as ``state``.
        wrap (bool, optional): see :func:`joint_error`; False is the published rule. Default: ``True``.

    Returns:
        [...] bool.

    Examples:
        >>> turned = np.array([2 * np.pi, 0.0])
        >>> bool(is_success(turned, np.zeros(2))), bool(is_success(turned, np.zeros(2), wrap=False))
        (True, False)
    """
    return (np.abs(joint_error(state, goal_state, wrap=wrap)) < TOLERANCE).all(-1)
