"""Physics of TwoRoom: a disc, a border, and a wall with one door.

All lengths are pixels of a 224 x 224 canvas, x to the right and y down. The agent is the centre of its disc: every
obstacle is enlarged by its radius, so that the wall is a slab between two faces::

      x = 21         100    112    124          203
        |  left room  |      |      |  right room |
        |             |######|######|             |   ###  obstacle
        |             |- - - - - - -|  y = 33.25  |
        |   start o-->|  corridor   |---> goal    |   door centre at y = 49
        |             |- - - - - - -|  y = 64.75  |
        |             |######|######|             |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args, Literal

import torch
from torch import Tensor

Collision = Literal["swept", "endpoint"]


@dataclass(frozen=True)
class TwoRoomGeometry:
    """The sizes of the scene, in pixels of the canvas; the defaults are those of the published TwoRoom task.

    Raises:
        ValueError: a step could jump across the wall or across the door, or the door does not fit into the wall.

    Examples:
        >>> geometry = TwoRoomGeometry()
        >>> geometry.low, geometry.high, geometry.face_left, geometry.face_right
        (21.0, 203.0, 100.0, 124.0)
        >>> geometry.door_low, geometry.door_high, geometry.rest_left, geometry.rest_right
        (33.25, 64.75, 99.5, 124.5)
    """

    canvas: int = 224  # width and height of the scene
    border: float = 14.0  # inner edge of the outer wall, from the edge of the canvas
    border_line: int = 4  # drawn thickness of the outer wall
    wall_center: float = 112.0  # x of the middle of the wall
    wall_half_thickness: float = 5.0
    door_center: float = 49.0  # y of the middle of the door
    door_half_extent: float = 14.0
    door_margin: float = 1.75  # distance past the drawn door at which the agent's centre still passes
    agent_radius: float = 7.0
    speed: float = 5.0  # distance moved along one axis by a full action
    rest_gap: float = 0.5  # distance from the face at which a stopped agent rests
    success_radius: float = 16.0  # goals closer than this (strictly) are reached

    def __post_init__(self) -> None:
        if not 0 < self.speed < min(self.face_right - self.face_left, self.door_high - self.door_low):
            raise ValueError(
                f"speed must be positive and below the width of the wall ({self.face_right - self.face_left}) and of "
                f"the door ({self.door_high - self.door_low}), got {self.speed}: a step may cross one face only."
            )
        if not self.low <= self.door_low < self.door_high <= self.high:
            raise ValueError(
                f"the door [{self.door_low}, {self.door_high}] must lie within the border [{self.low}, {self.high}]: "
                "move door_center or reduce door_half_extent."
            )

    @property
    def low(self) -> float:
        """Smallest coordinate of the agent's centre after a step."""
        return self.border + self.agent_radius

    @property
    def high(self) -> float:
        """Largest coordinate of the agent's centre after a step."""
        return self.canvas - self.border - self.agent_radius

    @property
    def face_left(self) -> float:
        """x at which an agent in the left room touches the wall."""
        return self.wall_center - self.wall_half_thickness - self.agent_radius

    @property
    def face_right(self) -> float:
        """x at which an agent in the right room touches the wall."""
        return self.wall_center + self.wall_half_thickness + self.agent_radius

    @property
    def rest_left(self) -> float:
        """x at which an agent stopped by the wall in the left room rests."""
        return self.face_left - self.rest_gap

    @property
    def rest_right(self) -> float:
        """x at which an agent stopped by the wall in the right room rests."""
        return self.face_right + self.rest_gap

    @property
    def door_low(self) -> float:
        """Smallest y at which the agent's centre passes the wall."""
        return self.door_center - self.door_half_extent - self.door_margin

    @property
    def door_high(self) -> float:
        """Largest y at which the agent's centre passes the wall."""
        return self.door_center + self.door_half_extent + self.door_margin


TWO_ROOM = TwoRoomGeometry()


def step(
    position: Tensor, action: Tensor, *, geometry: TwoRoomGeometry = TWO_ROOM, collision: Collision = "swept"
) -> Tensor:
    """Moves the agent by one action: ``position + speed * clip(action, -1, 1)``, as far as the walls allow.

    * ``"swept"`` follows the straight segment of the step. Where it crosses a face outside the door, x stops at the
      rest position and y continues. Inside the corridor, y is clamped to the door. The segment from the old to the
      new position therefore never passes through the obstacle.
    * ``"endpoint"`` is the rule of the published environment: only y at the end of the step is compared with the
      door. An agent may cut the corner of a jamb, and one that touches a jamb inside the corridor is moved back to
      the face of its half, up to 11.5 px away. Use it to reproduce published data.

    Both agree for steps that stay out of the slab, and for steps that enter it or stay in it within the door's span.

    Args:
        position (Tensor): [..., 2] float, x and y; must be legal (see :func:`is_legal`), which is not checked here.
        action (Tensor): [..., 2], any real dtype; computed in the dtype of ``position``.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.
        collision (str, optional): the wall rule, ``"swept"`` or ``"endpoint"``. Default: ``"swept"``.

    Returns:
        [..., 2], the new position, in the dtype of ``position``.

    Raises:
        ValueError: an unknown ``collision``.

    Examples:
        >>> start = torch.tensor([98.0, 150.0], dtype=torch.float64)
        >>> step(start, torch.tensor([1.0, 1.0])).tolist()
        [99.5, 155.0]
    """
    if collision not in get_args(Collision):
        raise ValueError(f"collision must be one of {get_args(Collision)}, got {collision!r}.")
    target = position + geometry.speed * action.to(position.dtype).clamp(-1.0, 1.0)
    target = target.clamp(geometry.low, geometry.high)
    resolve = _swept if collision == "swept" else _endpoint
    return resolve(position, target, geometry)


def in_wall(position: Tensor, *, geometry: TwoRoomGeometry = TWO_ROOM) -> Tensor:
    """Whether the agent's centre is inside the obstacle, which no step reaches.

    Args:
        position (Tensor): [..., 2] float.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [...] bool; the faces and the jambs themselves are free.
    """
    x, y = position.unbind(-1)
    return _in_slab(x, geometry) & ~_in_door(y, geometry)


def is_legal(position: Tensor, *, geometry: TwoRoomGeometry = TWO_ROOM) -> Tensor:
    """Whether an episode may start at a position: within the outer wall and not in the obstacle.

    Starts of the published task lie up to one radius closer to the outer wall than any step leads
    (:attr:`TwoRoomGeometry.low`); they are legal, and the first step moves them inwards.

    Args:
        position (Tensor): [..., 2] float.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [...] bool; false for NaN.
    """
    inside = (position >= geometry.border) & (position <= geometry.canvas - geometry.border)
    return inside.all(-1) & ~in_wall(position, geometry=geometry)


def _swept(position: Tensor, target: Tensor, geometry: TwoRoomGeometry) -> Tensor:
    x0, y0 = position.unbind(-1)
    x1, y1 = target.unbind(-1)
    starts_inside = _in_slab(x0, geometry)
    ends_inside = _in_slab(x1, geometry)
    crosses = starts_inside ^ ends_inside  # a step is shorter than the slab is wide: it crosses at most one face

    # The face that is crossed lies on the side of the end outside the slab.
    on_left = torch.where(starts_inside, x1, x0) < geometry.wall_center
    face = torch.where(on_left, geometry.face_left, geometry.face_right).to(x0.dtype)
    rest = torch.where(on_left, geometry.rest_left, geometry.rest_right).to(x0.dtype)
    fraction = (face - x0) / torch.where(crosses, x1 - x0, 1.0)
    misses_door = crosses & ~_in_door(y0 + fraction * (y1 - y0), geometry)

    stopped = ends_inside & misses_door
    # Clamped to the door: steps that end in the corridor, and steps that would leave it through a jamb.
    kept = ends_inside ^ misses_door
    x = torch.where(stopped, rest, x1)
    y = torch.where(kept, y1.clamp(geometry.door_low, geometry.door_high), y1)
    return torch.stack((x, y), dim=-1)  # [..., 2]


def _endpoint(position: Tensor, target: Tensor, geometry: TwoRoomGeometry) -> Tensor:
    x0 = position[..., 0]
    x1, y1 = target.unbind(-1)
    from_left = x0 < geometry.wall_center
    blocked = ~_in_door(y1, geometry)
    x = torch.where(from_left & (x1 > geometry.face_left) & blocked, geometry.rest_left, x1)
    x = torch.where(~from_left & (x1 < geometry.face_right) & blocked, geometry.rest_right, x)
    return torch.stack((x, y1), dim=-1)  # [..., 2]


def _in_slab(x: Tensor, geometry: TwoRoomGeometry) -> Tensor:
    return (x > geometry.face_left) & (x < geometry.face_right)


def _in_door(y: Tensor, geometry: TwoRoomGeometry) -> Tensor:
    return (y >= geometry.door_low) & (y <= geometry.door_high)
