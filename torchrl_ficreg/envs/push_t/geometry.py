"""The T as an obstacle: its outline, the poses it takes, and the shortest way around it.

Two frames are used. Window: pixels as in the state. Block: the frame of the block, origin at the middle of the bar's
top edge, as drawn in :mod:`~torchrl_ficreg.envs.push_t.physics`. A pose [3] is (x, y, angle) of the block's origin.
"""

from __future__ import annotations

import numpy as np

from torchrl_ficreg.envs.push_t.physics import AGENT_RADIUS, BAR, CENTER_OF_GRAVITY, STEM, T_CORNERS, WINDOW

CENTER = np.array(CENTER_OF_GRAVITY)
RECTANGLES = np.array([[np.min(part, 0), np.max(part, 0)] for part in (BAR, STEM)])  # [2, low and high, 2]

CLEARANCE = AGENT_RADIUS + 5.0  # px between the disc's centre and the T that a path must keep
MARGIN = 6.0  # px beyond it at which a path turns corners
TURNS = np.array([(-60, 0), (60, 0), (60, 30), (15, 120), (-15, 120), (-60, 30)], float)  # convex corners
TURNS += (CLEARANCE + MARGIN) * np.array([(-1, -1), (1, -1), (1, 1), (1, 1), (-1, 1), (-1, 1)])
OUTSIDE_COST = 10.0  # px of detour that a px outside the window is worth


def rotation(angle: float) -> np.ndarray:
    """The matrix [2, 2] that turns block directions into window directions."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def to_window(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Block points [..., 2] in the window, [..., 2]."""
    return points @ rotation(pose[2]).T + pose[:2]


def to_block(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Window points [..., 2] in the block's frame, [..., 2]."""
    return (points - pose[:2]) @ rotation(pose[2])


def difference(angle: np.ndarray | float, other: np.ndarray | float) -> np.ndarray | float:
    """The turn from the other angle to this one, in [-pi, pi)."""
    return (angle - other + np.pi) % (2 * np.pi) - np.pi


def overshoot(poses: np.ndarray, margin: float) -> np.ndarray:
    """How far the T reaches out of the window less a margin, in px.

    Args:
        poses: [..., 3].
        margin: width of the border that counts as outside, in px.

    Returns:
        [...], 0 inside.
    """
    cos, sin = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    x = poses[..., 0, None] + cos * T_CORNERS[:, 0] - sin * T_CORNERS[:, 1]
    y = poses[..., 1, None] + sin * T_CORNERS[:, 0] + cos * T_CORNERS[:, 1]
    reach = np.maximum(np.abs(x - WINDOW / 2), np.abs(y - WINDOW / 2)).max(-1)
    return np.maximum(reach - WINDOW / 2 + margin, 0.0)


def is_free(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether straight lines keep the clearance from the T.

    Args:
        start: [..., 2], in the block's frame.
        end: [..., 2], likewise.

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


def leave(point: np.ndarray) -> np.ndarray:
    """The nearest place that has the clearance from the T.

    Args:
        point: [2], in the block's frame.

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

    Legs that leave the window are possible but dear.

    Args:
        pose: [3], of the block.
        start: [2], in the window.
    """

    def __init__(self, pose: np.ndarray, start: np.ndarray) -> None:
        self.pose = pose
        self.exit = leave(to_block(pose, start))  # the first leg of a start that touches the T
        self._detour = OUTSIDE_COST * self._outside(TURNS)
        self._reach = self._legs(self.exit, TURNS) + self._detour  # [6], cost of the way to each corner
        self._previous = np.full(len(TURNS), -1)
        for _ in range(3):  # no shortest way turns more than four corners
            through = self._reach + _BETWEEN_TURNS + self._detour[:, None]  # [to, from]
            best = through.argmin(1)
            cost = through[np.arange(len(TURNS)), best]
            better = cost < self._reach - 1e-9
            self._previous = np.where(better, best, self._previous)
            self._reach = np.where(better, cost, self._reach)

    def _outside(self, points: np.ndarray) -> np.ndarray:
        away = np.abs(to_window(self.pose, points) - WINDOW / 2).max(-1)
        return np.maximum(away - (WINDOW / 2 - AGENT_RADIUS), 0.0)

    @staticmethod
    def _legs(start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        return np.where(is_free(start, ends), np.linalg.norm(ends - start, axis=-1), np.inf)

    def lengths(self, ends: np.ndarray) -> np.ndarray:
        """Costs of the paths to clear places [N, 2] in the block's frame, in px, [N]."""
        around = self._reach + self._legs(ends[:, None], TURNS)  # [N, 6]
        return np.minimum(self._legs(self.exit, ends), around.min(1))

    def waypoints(self, end: np.ndarray) -> list[np.ndarray]:
        """The corners of the path to a place [2] in the block's frame and the place itself, in the window."""
        end = leave(end)
        way = [end]
        around = self._reach + self._legs(end, TURNS)
        if around.min() < self._legs(self.exit, end[None])[0]:
            corner = int(around.argmin())
            while corner >= 0 and len(way) <= len(TURNS):
                way.append(TURNS[corner])
                corner = int(self._previous[corner])
        way.append(self.exit)
        return [to_window(self.pose, point) for point in reversed(way)]


_BETWEEN_TURNS = Paths._legs(TURNS[:, None], TURNS)
