"""Measures of the PushT scene, shared by physics, pictures and draws; no simulator is needed to know them.

Lengths are in pixels of a 512 x 512 window, x to the right and y down; angles in radians. The block's position is the
middle of the top edge of its bar, not its centre of gravity::

        (-60, 0) ____o____ (60, 0)      o  block position
                |__     __|
        y = 30     |   |                +  centre of gravity, (0, 45)
                   | + |
        y = 120    |___|
"""

from __future__ import annotations

import math

import numpy as np

WINDOW = 512
AGENT_RADIUS = 15.0
WALL_LOW, WALL_HIGH, WALL_RADIUS = 5.0, 506.0, 2.0
BAR = ((-60.0, 30.0), (60.0, 30.0), (60.0, 0.0), (-60.0, 0.0))
STEM = ((-15.0, 30.0), (-15.0, 120.0), (15.0, 120.0), (15.0, 30.0))
CENTER_OF_GRAVITY = (0.0, 45.0)
GOAL_POSE = (256.0, 256.0, math.pi / 4)  # of the green T, which is decoration: goals are drawn for each episode

T_CORNERS = np.array(BAR + STEM)  # [8, 2], in the frame of the block
STATE_SIZE = 7  # agent x, y; block x, y, angle in [0, 2 pi); agent velocity x, y in px/s


def wrap(angle: float) -> float:
    """Brings an angle to [0, 2 pi); one that is there already keeps its bits.

    Examples:
        >>> wrap(-1e-20), wrap(7.0) == 7.0 - 2 * math.pi
        (0.0, True)
    """
    wrapped = angle % (2 * math.pi)
    return wrapped if wrapped < 2 * math.pi else 0.0  # a tiny negative angle is rounded up to the whole turn


def part_distances(x: np.ndarray, y: np.ndarray, *, stem_top: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances of points, in the frame of the block, from the edges of its bar and of its stem.

    Args:
        x: [...] float.
        y: [...] float.
        stem_top: where the stem begins; 0 lets it reach through the bar, so that the two have no seam.

    Returns:
        two arrays [...], negative inside.

    Examples:
        >>> part_distances(np.array([0.0, 0.0]), np.array([10.0, 130.0]))
        (array([-10., 100.]), array([20., 10.]))
    """
    x = np.abs(x)
    return _rectangle(x, y, 60.0, 0.0, 30.0), _rectangle(x, y, 15.0, stem_top, 120.0)


def _rectangle(x: np.ndarray, y: np.ndarray, right: float, top: float, bottom: float) -> np.ndarray:
    beside = x - right
    beyond = np.abs(y - (top + bottom) / 2) - (bottom - top) / 2
    nearest = np.maximum(beside, beyond)  # exact inside, and outside where one of the two is negative
    corner = np.hypot(np.maximum(beside, 0), np.maximum(beyond, 0))
    return np.where(nearest > 0, corner, nearest)
