"""Which starts and goals an episode of PushT is made of, and when a goal is reached."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from torchrl_ficreg.envs.push_t.physics import (
    AGENT_RADIUS,
    part_distances,
    STATE_SIZE,
    T_CORNERS,
    WALL_HIGH,
    WALL_LOW,
    WALL_RADIUS,
)

SuccessRule = Literal["state", "block"]

AGENT_RANGE = (50.0, 450.0)  # px, both axes
BLOCK_RANGE = (100.0, 400.0)  # px, both axes
POSITION_TOLERANCE = 20.0  # px
ANGLE_TOLERANCE = math.pi / 9


def sample_state(rng: np.random.Generator, *, legacy_draws: bool = False) -> np.ndarray:
    """Draws a scene at rest: agent uniform over [50, 450]^2, block over [100, 400]^2 and all angles.

    Scenes in which two bodies overlap, 14 % of the draws, are drawn again: they could not have been reached by
    pushing, and the first steps would throw the block out of them.

    Args:
        rng: the source of randomness.
        legacy_draws: keep the overlaps, as the published environment does.

    Returns:
        [7] float64, see :mod:`torchrl_ficreg.envs.push_t.physics`.

    Examples:
        >>> state = sample_state(np.random.default_rng(0))
        >>> state.shape, is_free(state), state[5:].tolist()
        ((7,), True, [0.0, 0.0])
    """
    while True:
        state = np.zeros(STATE_SIZE)
        state[:2] = rng.uniform(*AGENT_RANGE, size=2)
        state[2:4] = rng.uniform(*BLOCK_RANGE, size=2)
        state[4] = rng.uniform(0.0, 2 * math.pi)
        if legacy_draws or is_free(state):
            return state


def is_free(state: np.ndarray) -> bool:
    """Tells whether the agent, the block and the walls of a scene [7] are clear of each other."""
    x, y, block_x, block_y, angle = state[:5].tolist()
    cosine, sine = math.cos(angle), math.sin(angle)
    corners = T_CORNERS @ np.array([[cosine, sine], [-sine, cosine]]) + (block_x, block_y)  # [8, 2]
    if corners.min() < WALL_LOW + WALL_RADIUS or corners.max() > WALL_HIGH - WALL_RADIUS:
        return False
    across, along = x - block_x, y - block_y
    bar, stem = part_distances(np.array(cosine * across + sine * along), np.array(cosine * along - sine * across))
    return bool(min(bar, stem) >= AGENT_RADIUS)


def angle_between(first: float, second: float) -> float:
    """The smaller angle between two directions, in [0, pi] rad.

    Examples:
        >>> round(angle_between(0.1, 6.2), 3)
        0.183
    """
    return abs((first - second + math.pi) % (2 * math.pi) - math.pi)


def is_success(state: np.ndarray, goal_state: np.ndarray, *, success_on: SuccessRule = "state") -> bool:
    """Tells whether a goal is reached: places within 20 px and the angle of the block within 20 degrees.

    Args:
        state: [7] float.
        goal_state: [7] float.
        success_on: ``"state"`` takes one distance in four dimensions, x and y of agent and block, so that the agent
            must arrive too, as the published rule does; ``"block"`` asks only for x and y of the block.

    Returns:
        whether both are below their tolerances.
    """
    first = 0 if success_on == "state" else 2
    distance = math.dist(state[first:4], goal_state[first:4])
    return distance < POSITION_TOLERANCE and angle_between(float(state[4]), float(goal_state[4])) < ANGLE_TOLERANCE
