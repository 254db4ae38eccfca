"""Pictures of TwoRoom: black walls on white, the agent a soft red disc.

At 224 pixels the picture is the published one. Other resolutions show the same scene: the walls are area-averaged,
so that thin lines fade instead of vanishing, and the disc is evaluated at the centres of the coarser pixels, so that
it moves smoothly with the agent.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from torchrl_ficreg.envs.two_room.physics import TWO_ROOM, TwoRoomGeometry

AGENT_COLOR = (255.0, 0.0, 0.0)
GOAL_COLOR = (0.0, 255.0, 0.0)
_FAINTEST = 1e-9
_CHUNK_PIXELS = 1 << 17  # pixels blended at a time: keeps the float buffers of large batches in the cache


def render_pixels(
    position: Tensor, *, size: int = 224, goal: Tensor | None = None, geometry: TwoRoomGeometry = TWO_ROOM
) -> Tensor:
    """Draws the agent in its rooms.

    The disc is ``exp(-d**2 / (2 * radius**2))``, d being the distance of a pixel centre from the agent, divided by
    its largest value over the picture: the pixel nearest to the agent is pure red. Blended in float32, truncated.

    Args:
        position (Tensor): [..., 2] float, x and y of the agent on the canvas.
        size (int, optional): height and width of the picture, in pixels. Default: ``224``.
        goal (Tensor, optional): [..., 2] float, drawn as a green disc below the agent. Default: ``None``, no goal.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [..., 3, size, size] uint8, red, green, blue.

    Raises:
        ValueError: ``size`` is not a positive integer, or the shapes are wrong.

    Examples:
        >>> picture = render_pixels(torch.tensor([[60.0, 112.0], [164.0, 49.0]]))
        >>> picture.shape, picture[0, :, 112, 60].tolist(), picture[1, :, 100, 112].tolist()
        (torch.Size([2, 3, 224, 224]), [255, 0, 0], [0, 0, 0])
    """
    if position.shape[-1:] != (2,):
        raise ValueError(f"position must be [..., 2], got {tuple(position.shape)}: pass x and y in the last dimension.")
    if goal is not None and goal.shape != position.shape:
        raise ValueError(f"goal must have the shape of position {tuple(position.shape)}, got {tuple(goal.shape)}.")
    walls = background(size, geometry).to(position.device)  # [size, size]
    agents = position.reshape(-1, 2)  # [N, 2]
    goals = None if goal is None else goal.reshape(-1, 2)
    pictures = torch.empty(len(agents), 3, size, size, dtype=torch.uint8, device=position.device)
    chunk = max(1, _CHUNK_PIXELS // size**2)
    for start in range(0, len(agents), chunk):
        rows = slice(start, start + chunk)
        channels = [walls, walls, walls]
        if goals is not None:
            channels = _blend(channels, _disc(goals[rows], size, geometry), GOAL_COLOR)
        channels = _blend(channels, _disc(agents[rows], size, geometry), AGENT_COLOR)
        for index, channel in enumerate(channels):
            pictures[rows, index] = channel  # the cast truncates
    return pictures.reshape(*position.shape[:-1], 3, size, size)


def _blend(channels: list[Tensor], alpha: Tensor, color: tuple[float, float, float]) -> list[Tensor]:
    """Blends a colour into each channel; channels that are equal before and after are computed once."""
    done: dict[tuple[int, float], Tensor] = {}
    for channel, value in zip(channels, color, strict=True):
        key = (id(channel), value)
        if key not in done:
            # Written as channel + alpha * (value - channel), so that a channel that already has the value keeps it:
            # a float sum of the two terms may be below it and be truncated to one grey level less.
            done[key] = torch.addcmul(channel, alpha, value - channel)  # [n, size, size]
    return [done[id(channel), value] for channel, value in zip(channels, color, strict=True)]


def _disc(center: Tensor, size: int, geometry: TwoRoomGeometry) -> Tensor:
    """The opacity of a soft disc: [n, 2] -> [n, size, size] float32 with maximum 1."""
    pixels = _pixel_centers(size, geometry).to(center.device)  # [size]
    # exp(-(dx^2 + dy^2)) is a product, so two lines of exponentials make the whole picture.
    squared = (center.unsqueeze(-1) - pixels).square()  # [n, 2, size]
    squared = squared - squared.amin(-1, keepdim=True)  # the division by the maximum, before the exponential
    # exp2, because torch.exp of float64 uses all of MKL's threads for these few numbers: on a busy CPU, 100x slower.
    lines = torch.exp2(squared * (-0.5 * math.log2(math.e) / geometry.agent_radius**2))
    # Values too small to change a grey level become zero: their products are subnormal, and slow to compute.
    lines = torch.where(lines < _FAINTEST, 0.0, lines).to(torch.float32)
    return lines[:, 1, :, None] * lines[:, 0, None, :]  # rows are y, columns are x


@functools.lru_cache(maxsize=32)
def _pixel_centers(size: int, geometry: TwoRoomGeometry) -> Tensor:
    """Canvas coordinates of the pixel centres: [size] float64, the integers when size is that of the canvas."""
    return (torch.arange(size, dtype=torch.float64) + 0.5) * (geometry.canvas / size) - 0.5


@functools.lru_cache(maxsize=32)
def background(size: int, geometry: TwoRoomGeometry = TWO_ROOM) -> Tensor:
    """The empty rooms, as grey levels.

    Args:
        size (int): height and width, in pixels.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [size, size] float32 from 0 (wall) to 255 (floor). The result is cached and shared: do not write to it.

    Raises:
        ValueError: ``size`` is not a positive integer.
    """
    if not isinstance(size, int) or size < 1:
        raise ValueError(f"size must be a positive integer, got {size!r}.")
    canvas = geometry.canvas
    along = torch.arange(canvas, dtype=torch.float64)
    wall = (along - geometry.wall_center).abs() <= geometry.wall_half_thickness  # columns
    door = (along - geometry.door_center).abs() <= geometry.door_half_extent  # rows
    near = (along >= geometry.border - geometry.border_line) & (along < geometry.border)
    line = near | near.flip(0)
    dark = (wall[None, :] & ~door[:, None]) | line[None, :] | line[:, None]
    levels = torch.where(dark, 0.0, 255.0).to(torch.float64)  # [canvas, canvas]
    overlap = _area_average(canvas, size)
    return (overlap @ levels @ overlap.T).to(torch.float32)


def _area_average(source: int, size: int) -> Tensor:
    """Share of each source pixel in each target pixel of a line: [size, source] float64, rows sum to 1."""
    edges = torch.arange(size + 1, dtype=torch.float64) * source / size
    pixel = torch.arange(source, dtype=torch.float64)
    upper = torch.minimum(edges[1:, None], pixel + 1)
    lower = torch.maximum(edges[:-1, None], pixel)
    return (upper - lower).clamp(min=0) * size / source
