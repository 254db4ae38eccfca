"""Pictures of PushT: the T and the disc on white, the walls, and a decorative green T at a fixed place.

Colours, outlines and order of drawing are those of the published picture: the green T, the bar and the stem of the
block, the disc, the walls. The scene is sampled by signed distances on a grid with a spacing of at most two pixels of
the window, with edges blended over one sample, and then area-averaged: a small picture is the average of a large one.
At 224 px the mean absolute difference from the published picture is 0.4 of 255 grey levels; moving the block by one
pixel of the window changes 0.17. The red marks of the published picture where the disc touches the block are left out:
two pixels, 0.005.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np

from torchrl_ficreg.envs.push_t.geometry import (
    AGENT_RADIUS,
    corners,
    DECORATION_POSE,
    part_distances,
    STATE_SIZE,
    WALL_HIGH,
    WALL_LOW,
    WALL_RADIUS,
    WINDOW,
)

WHITE = (255.0, 255.0, 255.0)
GOAL_COLOR = (144.0, 238.0, 144.0)
BLOCK_COLOR, OUTLINE_COLOR = (143.0, 163.0, 184.0), (119.0, 136.0, 153.0)
RIM_COLOR, AGENT_COLOR = (65.0, 105.0, 225.0), (78.0, 126.0, 255.0)
WALL_COLOR = (211.0, 211.0, 211.0)

OUTLINE_RADIUS = 2.0  # of the round pen along the edges of the block, px of the window
INNER_RADIUS = 11.0  # of the disc within its rim
# pygame fills every pixel that an edge crosses, which widens pens and polygons without outline by half a pixel at each
# side, and gives discs an even diameter, whose middle lies half a pixel up and left.
_GROWTH = 0.5
_DISC_SHIFT = -0.5
_PEN = OUTLINE_RADIUS + _GROWTH
_COARSEST_SAMPLE = 2.0  # px of the window: the width of the outline's pen


def render_pixels(states: np.ndarray, *, size: int = 224, draw_goal: bool = True) -> np.ndarray:
    """Draws scenes.

    Args:
        states (np.ndarray): [..., 7], see :mod:`torchrl_ficreg.envs.push_t.geometry`; the velocities are not drawn.
        size (int, optional): height and width of the pictures, in pixels. Default: ``224``.
        draw_goal (bool, optional): draw the green T of the published picture, a decoration that marks no goal. Default:
            ``True``.

    Returns:
        [..., 3, size, size] uint8, red, green, blue; a new array.

    Raises:
        ValueError: ``size`` is not a positive integer, the shape is wrong, or a number is not finite.

    Examples:
        >>> picture = render_pixels(np.array([100.0, 100.0, 300.0, 300.0, 0.0, 0.0, 0.0]), size=64)
        >>> picture.shape, picture[:, 12, 12].tolist(), picture[:, 39, 37].tolist()
        ((3, 64, 64), [78, 126, 255], [143, 163, 184])
    """
    states = np.asarray(states, dtype=np.float64)
    if states.shape[-1:] != (STATE_SIZE,):
        raise ValueError(f"states must be [..., {STATE_SIZE}], got {states.shape}: pass whole states.")
    if not np.isfinite(states[..., :5]).all():
        raise ValueError("states must be finite: look for a NaN in the positions or the angle.")
    canvas = _canvas(size, draw_goal)
    rows = states.reshape(-1, STATE_SIZE)  # [N, 7]
    pictures = np.empty((len(rows), 3, size, size), dtype=np.uint8)
    for row, picture in zip(rows, pictures, strict=True):
        canvas.draw(row, picture)
    return pictures.reshape(*states.shape[:-1], 3, size, size)


@functools.lru_cache(maxsize=16)
def _canvas(size: int, draw_goal: bool) -> _Canvas:
    return _Canvas(size, draw_goal)


class _Canvas:
    """Draws pictures of one size; holds the sampling grid and the scene without block and disc.

    Only the boxes around the block and the disc are sampled for a picture; the rest is copied.
    """

    def __init__(self, size: int, draw_goal: bool) -> None:
        if not isinstance(size, int) or size < 1:
            raise ValueError(f"size must be a positive integer, got {size!r}.")
        self.size = size
        self.fold = math.ceil(WINDOW / size / _COARSEST_SAMPLE)  # samples per pixel and axis
        self.spacing = WINDOW / (size * self.fold)  # px of the window between two samples
        # Published pictures have their pixel centres at the integers of the window, so it begins at -0.5.
        self.grid = ((np.arange(size * self.fold) + 0.5) * self.spacing - 0.5).astype(np.float32)  # [S]
        full = (slice(0, size), slice(0, size))
        self.floor = np.broadcast_to(_column(WHITE), (3, len(self.grid), len(self.grid))).copy()  # [3, S, S]
        if draw_goal:
            parts = part_distances(*self._block_frame(DECORATION_POSE, *full), stem_top=0.0)
            _paint(self.floor, self._cover(np.minimum(*parts) - _GROWTH), GOAL_COLOR)
        centers = (WALL_LOW + WALL_HIGH) / 2
        from_center = np.abs(self.grid - centers)
        square = np.maximum(from_center[:, None], from_center[None, :])
        self.wall = self._cover(np.abs(square - (WALL_HIGH - WALL_LOW) / 2) - WALL_RADIUS - _GROWTH)  # [S, S]
        self.empty = self._average(_paint(self.floor.copy(), self.wall, WALL_COLOR), *full)  # [3, size, size] uint8

    def draw(self, state: np.ndarray, picture: np.ndarray) -> None:
        """Draws one state [7] into ``picture`` [3, size, size] uint8."""
        x, y, *pose = state[:5].tolist()
        x, y = x + _DISC_SHIFT, y + _DISC_SHIFT
        picture[:] = self.empty
        across, along = corners(state[2:5])  # [8] each
        rows = self._pixels(along.min() - _PEN, along.max() + _PEN)
        block = rows, self._pixels(across.min() - _PEN, across.max() + _PEN)
        self._paint_box(picture, block, pose, None)
        disc = self._pixels(y - AGENT_RADIUS, y + AGENT_RADIUS), self._pixels(x - AGENT_RADIUS, x + AGENT_RADIUS)
        apart = any(a.start >= b.stop or b.start >= a.stop for a, b in zip(block, disc, strict=True))
        self._paint_box(picture, disc, None if apart else pose, (x, y))

    def _paint_box(
        self,
        picture: np.ndarray,
        box: tuple[slice, slice],
        pose: list[float] | None,
        center: tuple[float, float] | None,
    ) -> None:
        rows, columns = box
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        samples = tuple(slice(part.start * self.fold, part.stop * self.fold) for part in box)
        colors = self.floor[(slice(None), *samples)].copy()  # [3, h, w]
        if pose is not None:
            bar, stem = part_distances(*self._block_frame(pose, rows, columns))
            _paint(colors, self._cover(np.minimum(bar, stem)), BLOCK_COLOR)
            _paint(colors, self._cover(np.minimum(np.abs(bar), np.abs(stem)) - _PEN), OUTLINE_COLOR)
        if center is not None:
            across = self.grid[samples[1]] - np.float32(center[0])
            along = self.grid[samples[0]] - np.float32(center[1])
            distance = np.sqrt(np.square(across)[None, :] + np.square(along)[:, None])
            _paint(colors, self._cover(distance - AGENT_RADIUS), RIM_COLOR)
            _paint(colors, self._cover(distance - INNER_RADIUS), AGENT_COLOR)
        wall = self.wall[samples]
        if wall.any():
            _paint(colors, wall, WALL_COLOR)
        picture[(slice(None), *box)] = self._average(colors, rows, columns)

    def _pixels(self, low: float, high: float) -> slice:
        """The pixels that an interval of the window covers along one axis, one sample of blending included."""
        pixel = self.spacing * self.fold
        start = math.floor((low + 0.5 - self.spacing) / pixel)
        stop = math.ceil((high + 0.5 + self.spacing) / pixel)
        return slice(max(start, 0), min(stop, self.size))

    def _block_frame(self, pose: Sequence[float], rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the samples of a box in the frame of a block: two arrays [h, w] float32."""
        x = self.grid[columns.start * self.fold : columns.stop * self.fold] - np.float32(pose[0])
        y = self.grid[rows.start * self.fold : rows.stop * self.fold, None] - np.float32(pose[1])
        cosine, sine = np.float32(math.cos(pose[2])), np.float32(math.sin(pose[2]))
        return cosine * x + sine * y, cosine * y - sine * x

    def _cover(self, distance: np.ndarray) -> np.ndarray:
        """Share of each sample's cell in which a signed distance is negative, in [0, 1]."""
        return np.clip(np.float32(0.5) - distance / np.float32(self.spacing), 0, 1)

    def _average(self, colors: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
        """Area average of samples: [3, h * fold, w * fold] float32 -> [3, h, w] uint8."""
        height, width = rows.stop - rows.start, columns.stop - columns.start
        lines = colors.reshape(3, height, self.fold, width * self.fold).sum(2)
        cells = lines.reshape(3, height, width, self.fold).sum(3)
        return np.rint(cells * np.float32(1 / self.fold**2)).astype(np.uint8)


def _column(color: tuple[float, float, float]) -> np.ndarray:
    return np.array(color, dtype=np.float32)[:, None, None]


def _paint(colors: np.ndarray, cover: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    """Blends a colour into [3, h, w] samples in place, with opacity ``cover`` [h, w]."""
    colors += cover * (_column(color) - colors)
    return colors
