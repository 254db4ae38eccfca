"""Geometry of PushT: the sizes of its bodies, the frame of the T, and shortest paths around the T.

Lengths are pixels of a 512 x 512 window, x to the right and y down; angles are in radians. Importing this module needs
no simulator. A pose [3] is x, y and angle of the block. Its position is the middle of the top edge of its bar, not its
centre of gravity::

        (-60, 0) ____o____ (60, 0)      o  block position, origin of the block's frame
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
DECORATION_POSE = (256.0, 256.0, math.pi / 4)  # of the green T of the pictures; goals are drawn for each episode
STATE_SIZE = 7  # agent x, y; block x, y, angle in [0, 2 pi); agent velocity x, y in px/s

CENTER = np.array(CENTER_OF_GRAVITY)
CORNERS = np.array(BAR + STEM)  # [8, 2], in the block's frame
RECTANGLES = np.array([[np.min(part, 0), np.max(part, 0)] for part in (BAR, STEM)])  # [2, low and high, 2]

CLEARANCE = AGENT_RADIUS + 5.0  # px between the disc's centre and the T that a path must keep
MARGIN = 6.0  # px beyond it at which a path turns corners
TURNS = np.array([(-60, 0), (60, 0), (60, 30), (15, 120), (-15, 120), (-60, 30)], float)  # convex corners
TURNS += (CLEARANCE + MARGIN) * np.array([(-1, -1), (1, -1), (1, 1), (1, 1), (-1, 1), (-1, 1)])
OUTSIDE_COST = 10.0  # px of detour that a px outside the window is worth


def rotation(angle: float) -> np.ndarray:
    """The matrix [2, 2] that rotates directions of the block's frame by ``angle``, in rad, into the window."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def to_window(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Maps points [..., 2] of the block's frame to the window, [..., 2], for a block at ``pose`` [3]."""
    return points @ rotation(pose[2]).T + pose[:2]


def to_block(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Maps points [..., 2] of the window to the block's frame, [..., 2], for a block at ``pose`` [3]."""
    return (points - pose[:2]) @ rotation(pose[2])


def corners(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the bar and the stem in the window.

    Args:
        poses (np.ndarray): [..., 3].

    Returns:
        x and y, [..., 8] each.

    Examples:
        >>> x, y = corners(np.array([100.0, 200.0, 0.0]))
        >>> [float(value) for value in (x.min(), x.max(), y.min(), y.max())]
        [40.0, 160.0, 200.0, 320.0]
    """
    cos, sin = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    x = poses[..., 0, None] + cos * CORNERS[:, 0] - sin * CORNERS[:, 1]
    y = poses[..., 1, None] + sin * CORNERS[:, 0] + cos * CORNERS[:, 1]
    return x, y


def overshoot(poses: np.ndarray, margin: float) -> np.ndarray:
    """The largest distance by which the T reaches out of the window less a margin.

    Args:
        poses (np.ndarray): [..., 3].
        margin (float): width of the border that counts as outside, in px.

    Returns:
        [...] in px; 0 inside.
    """
    x, y = corners(poses)
    reach = np.maximum(np.abs(x - WINDOW / 2), np.abs(y - WINDOW / 2)).max(-1)
    return np.maximum(reach - WINDOW / 2 + margin, 0.0)


def part_distances(x: np.ndarray, y: np.ndarray, *, stem_top: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances of points from the edges of the bar and of the stem.

    Args:
        x (np.ndarray): [...], in the block's frame.
        y (np.ndarray): [...], in the block's frame.
        stem_top (float, optional): y at which the stem begins; 0 lets it reach through the bar, so that the union of
            the two has no seam. Default: ``30.0``.

    Returns:
        two arrays [...] in px, negative inside.

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


def is_clear_line(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether straight lines keep the clearance from the T.

    Args:
        start (np.ndarray): [..., 2], in the block's frame.
        end (np.ndarray): [..., 2], in the block's frame.

    Returns:
        [...] bool.
    """
    step = (end - start)[..., None, :]
    step = np.where(np.abs(step) < 1e-9, 1e-9, step)
    low = (RECTANGLES[:, 0] - CLEARANCE - start[..., None, :]) / step
    high = (RECTANGLES[:, 1] + CLEARANCE - start[..., None, :]) / step
    enters = np.minimum(low, high).max(-1)
    leaves = np.maximum(low, high).min(-1)
    return (np.maximum(enters, 0.0) >= np.minimum(leaves, 1.0)).all(-1)


def nearest_clear(point: np.ndarray) -> np.ndarray:
    """The nearest place that keeps the clearance from the T.

    Args:
        point (np.ndarray): [2], in the block's frame.

    Returns:
        [2]; the point itself where it is clear.
    """
    inside = _inside(point[None])
    if not inside[0]:
        return point
    # Leaving one inflated rectangle may end in the other: of all the corners and foot points take the nearest clear.
    low, high = RECTANGLES[:, 0] - CLEARANCE - 1e-6, RECTANGLES[:, 1] + CLEARANCE + 1e-6
    xs = np.array([point[0], *low[:, 0], *high[:, 0]])
    ys = np.array([point[1], *low[:, 1], *high[:, 1]])
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    places = places[~_inside(places)]
    return places[np.argmin(np.linalg.norm(places - point, axis=1))]


def _inside(points: np.ndarray) -> np.ndarray:
    low, high = RECTANGLES[:, 0] - CLEARANCE, RECTANGLES[:, 1] + CLEARANCE
    return ((points[:, None] > low) & (points[:, None] < high)).all(-1).any(-1)


class Paths:
    """Shortest paths around the T from one place, through the inflated convex corners of its outline.

    Paths may leave the window, at a cost of 10 px for each px outside.

    Args:
        pose (np.ndarray): [3], of the block.
        start (np.ndarray): [2], in the window.
    """

    def __init__(self, pose: np.ndarray, start: np.ndarray) -> None:
        self.pose = pose
        self.exit = nearest_clear(to_block(pose, start))  # the first leg of a start that touches the T
        self._detour = OUTSIDE_COST * self._outside(TURNS)
        self._reach = self._legs(self.exit, TURNS) + self._detour  # [6], cost of the path to each corner
        self._previous = np.full(len(TURNS), -1)
        for _ in range(3):  # no shortest path turns more than four corners
            through = self._reach + _BETWEEN_TURNS + self._detour[:, None]  # [to, from]
            best = through.argmin(1)
            cost = through[np.arange(len(TURNS)), best]
            better = cost < self._reach - 1e-9
            self._previous = np.where(better, best, self._previous)
            self._reach = np.where(better, cost, self._reach)

    def lengths(self, ends: np.ndarray) -> np.ndarray:
        """Costs of the paths to clear places [N, 2] of the block's frame, [N] in px."""
        around = self._reach + self._legs(ends[:, None], TURNS)  # [N, 6]
        return np.minimum(self._legs(self.exit, ends), around.min(1))

    def waypoints(self, end: np.ndarray) -> list[np.ndarray]:
        """The corners of the path to a place [2] of the block's frame and the place itself, [2] each, in the window."""
        end = nearest_clear(end)
        path = [end]
        around = self._reach + self._legs(end, TURNS)
        if around.min() < self._legs(self.exit, end[None])[0]:
            corner = int(around.argmin())
            while corner >= 0 and len(path) <= len(TURNS):
                path.append(TURNS[corner])
                corner = int(self._previous[corner])
        path.append(self.exit)
        return [to_window(self.pose, point) for point in reversed(path)]

    def _outside(self, points: np.ndarray) -> np.ndarray:
        away = np.abs(to_window(self.pose, points) - WINDOW / 2).max(-1)
        return np.maximum(away - (WINDOW / 2 - AGENT_RADIUS), 0.0)

    @staticmethod
    def _legs(start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        return np.where(is_clear_line(start, ends), np.linalg.norm(ends - start, axis=-1), np.inf)


_BETWEEN_TURNS = Paths._legs(TURNS[:, None], TURNS)
