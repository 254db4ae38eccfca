"""Tasks of PushT: the draws of starts and goals, and the success rule."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.push_t.geometry import (
    AGENT_RADIUS,
    corners,
    part_distances,
    STATE_SIZE,
    to_block,
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
    """Draws a start or a goal, at rest: agent uniform over [50, 450]^2, block over [100, 400]^2 and all angles.

    Scenes in which two bodies overlap, 14 % of the draws, are drawn again: no push leads to them, and the first steps
    would separate the bodies.

    Args:
        rng (np.random.Generator): source of randomness.
        legacy_draws (bool, optional): keep overlaps, as the published environment does. Default: ``False``.

    Returns:
        [7] float64, see :mod:`torchrl_ficreg.envs.push_t.geometry`.

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
    """Whether the agent, the block and the walls of a scene [7] do not overlap."""
    pose = state[2:5]
    x, y = corners(pose)  # [8] each
    if min(x.min(), y.min()) < WALL_LOW + WALL_RADIUS or max(x.max(), y.max()) > WALL_HIGH - WALL_RADIUS:
        return False
    bar, stem = part_distances(*to_block(pose, state[:2]))
    return bool(min(bar, stem) >= AGENT_RADIUS)


def is_success(state: np.ndarray, goal_state: np.ndarray, *, success_on: SuccessRule = "state") -> bool:
    """Whether a goal is reached: position within 20 px and angle of the block within 20 degrees.

    Args:
        state (np.ndarray): [7].
        goal_state (np.ndarray): [7].
        success_on (str, optional): ``"state"``, the published rule, takes one distance in four dimensions, x and y of
            agent and block, so that the agent must arrive too; ``"block"`` takes x and y of the block alone. Default:
            ``"state"``.

    Returns:
        whether distance and angle are below their tolerances.
    """
    first = 0 if success_on == "state" else 2
    distance = math.dist(state[first:4], goal_state[first:4])
    angle = abs(wrap_angle(float(state[4]) - float(goal_state[4])))
    return distance < POSITION_TOLERANCE and angle < ANGLE_TOLERANCE
