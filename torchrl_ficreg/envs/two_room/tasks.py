"""Tasks of TwoRoom: the draws of starts and goals, and the success rule."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from torchrl_ficreg.envs.two_room.physics import TWO_ROOM, TwoRoomGeometry

MIN_STEPS = 25  # of a noiseless expert, as in the published data: 125 px through the door at 5 px per step


def sample_start(rng: np.random.Generator, *, geometry: TwoRoomGeometry = TWO_ROOM) -> np.ndarray:
    """Draws a start uniformly over the two rooms, the slab of the wall excluded.

    Args:
        rng (np.random.Generator): source of randomness.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [2] float64, x and y.
    """
    while True:
        start = rng.uniform(geometry.low, geometry.high, size=2)
        if not geometry.face_left <= start[0] <= geometry.face_right:
            return start


def sample_goal(
    rng: np.random.Generator,
    start: np.ndarray,
    *,
    geometry: TwoRoomGeometry = TWO_ROOM,
    min_steps: int = MIN_STEPS,
) -> np.ndarray:
    """Draws a goal uniformly over those of the opposite room that are far enough through the door.

    Far enough: ``(|start - door| + |door - goal|) / speed >= min_steps``.

    Args:
        rng (np.random.Generator): source of randomness.
        start (np.ndarray): [2], where the agent begins.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.
        min_steps (int, optional): least number of full-speed steps along the path through the centre of the door.
            Default: ``25``.

    Returns:
        [2] float64, x and y.

    Raises:
        ValueError: no goal of the opposite room is that far away.
    """
    door = np.array([geometry.wall_center, geometry.door_center])
    from_left = start[0] < geometry.wall_center
    remaining = min_steps * geometry.speed - np.linalg.norm(start - door)
    farthest_x = geometry.high if from_left else geometry.low
    farthest = max(np.linalg.norm([farthest_x - door[0], y - door[1]]) for y in (geometry.low, geometry.high))
    if farthest < remaining:
        raise ValueError(f"no goal is {min_steps} steps away from {start.tolist()}: reduce min_steps.")
    while True:
        goal = rng.uniform(geometry.low, geometry.high, size=2)
        opposite = goal[0] > geometry.face_right if from_left else goal[0] < geometry.face_left
        if opposite and np.linalg.norm(goal - door) >= remaining:
            return goal


def sample_task(
    rng: np.random.Generator, *, geometry: TwoRoomGeometry = TWO_ROOM, min_steps: int = MIN_STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Draws a start and a goal in opposite rooms.

    Args:
        rng (np.random.Generator): source of randomness.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.
        min_steps (int, optional): see :func:`sample_goal`. Default: ``25``.

    Returns:
        start [2] and goal [2], float64.

    Examples:
        >>> start, goal = sample_task(np.random.default_rng(0))
        >>> bool((start[0] < 100) != (goal[0] < 100))
        True
    """
    start = sample_start(rng, geometry=geometry)
    return start, sample_goal(rng, start, geometry=geometry, min_steps=min_steps)


def is_success(position: Tensor, goal: Tensor, *, geometry: TwoRoomGeometry = TWO_ROOM) -> Tensor:
    """Whether the agent is strictly closer to the goal than the success radius.

    Args:
        position (Tensor): [..., 2] float.
        goal (Tensor): [..., 2] float, broadcast against ``position``.
        geometry (TwoRoomGeometry, optional): the scene. Default: ``TWO_ROOM``.

    Returns:
        [...] bool.
    """
    return (position - goal).square().sum(-1).sqrt() < geometry.success_radius
