"""Expert of PushT: pushes the T from one target pose to the next and so records data.

Its model of a push is quasi-static. Contacts have no friction and the block rests unless it is touched, so a disc that
moves by s along the inward normal n of a face turns the block by a constant twist in the block's frame: with the lever
tau = r x n about the centre of gravity and the ratio k = moment / mass,

    centre:  s n / (1 + tau^2 / k)        angle:  (s tau / k) / (1 + tau^2 / k).

The disc is assumed to stay on the same point of the face, which then moves on a circle.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.push_t.geometry import (
    AGENT_RADIUS,
    CENTER,
    nearest_clear,
    overshoot,
    Paths,
    rotation,
    to_block,
    to_window,
    WINDOW,
)
from torchrl_ficreg.envs.push_t.physics import BLOCK_MASS, BLOCK_MOMENT, SUBSTEPS, TIME_STEP

if TYPE_CHECKING:
    from torchrl_ficreg.envs.push_t.env import PushTEnv

RATIO = BLOCK_MOMENT / BLOCK_MASS  # px^2
STAND_OFF = 14.0  # px between the disc's edge and the face where an approach ends
REACH = 40.69  # px per step at which the disc settles under a constant action of 1
STEP_TIME = TIME_STEP * SUBSTEPS  # s
SPEED_UP = 5.0  # px per step that the disc may be faster than in the step before
TURN_WEIGHT = 50.0  # px that a radian of the block's angle is worth
REACHED = 8.0  # px of pose error below which a target is reached
DEPTHS = np.concatenate([np.arange(0.0, 24.0, 3.0), np.arange(24.0, 130.0, 8.0)])  # px, candidate lengths of a push
BORDER = 25.0  # px along the walls that the T is kept out of
OVERSHOOT_WEIGHT = 3.0  # px of pose error that a px in the border is worth
PATIENCE, GOAL_PATIENCE = 80, 200  # most steps for a target of its own, and for the goal

# first and last x (of horizontal faces) or y (of vertical ones), the other coordinate, number of contacts, inward normal
_FACES = (
    ((-52, 52), 0, 13, (0, 1)),  # top of the bar
    ((6, 24), 60, 3, (-1, 0)),  # ends of the bar
    ((6, 24), -60, 3, (1, 0)),
    ((31, 52), 30, 4, (0, -1)),  # underside of the bar, from the concave corners outwards
    ((-52, -31), 30, 4, (0, -1)),
    ((46, 112), 15, 9, (-1, 0)),  # sides of the stem
    ((46, 112), -15, 9, (1, 0)),
    ((-8, 8), 120, 3, (0, -1)),  # end of the stem
)


def _contacts() -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for (first, last), other, number, normal in _FACES:
        for along in np.linspace(first, last, number):
            points.append((along, other) if normal[0] == 0 else (other, along))
            normals.append(normal)
    return np.array(points, float), np.array(normals, float)


POINTS, NORMALS = _contacts()  # [N, 2] each, in the block's frame; normals point into the block
LEVERS = (POINTS[:, 0] - CENTER[0]) * NORMALS[:, 1] - (POINTS[:, 1] - CENTER[1]) * NORMALS[:, 0]  # [N], px
STANDS = np.stack([nearest_clear(place) for place in POINTS - (AGENT_RADIUS + STAND_OFF) * NORMALS])  # [N, 2]


class PushTExpert:
    """Moves the T to target poses by pushes, with paths around the T and free motion in between.

    A target pose is at most 130 px and 110 degrees away, in the interior of the window. For each push, all contacts and
    many depths are evaluated in the quasi-static model, and the one with the largest gain per step is taken, the path
    around the T included. The disc approaches with a clearance of 20 px, pushes along the normal of the face while it
    follows the contact point, and is corrected at each step. Some pushes are random, and some of them are followed by
    free motion or rest. Speeds are drawn anew for every movement.

    One object records one episode: it keeps the state of its current movement.

    Args:
        rng (np.random.Generator, optional): source of all randomness. Default: ``np.random.default_rng(0)``.
        env (PushTEnv, optional): not used; part of the :class:`~torchrl_ficreg.envs.registry.Expert` protocol.
            Default: ``None``.
        noise_std (float, optional): standard deviation of the Gaussian noise on every action component, in actions.
            Default: ``0.05``.
        speed (float, optional): mean speed of a push, in px per step, in (0, 25]. Default: ``9.0``.
        approach_speed (float, optional): mean speed of the disc between pushes, in px per step, in (0, 25]. Default:
            ``14.0``.
        goal_share (float, optional): probability that the first target is the block's pose in ``goal_state``. Default:
            ``0.2``.
        random_share (float, optional): probability that a push is random. Default: ``0.15``.
        free_share (float, optional): probability of free motion after a push. Default: ``0.15``.

    Attributes:
        target: [3], the pose of the block that is pursued; None before the first action.

    Raises:
        ValueError: an argument is out of range.

    Examples:
        >>> expert = PushTExpert(rng=np.random.default_rng(0))
        >>> state = np.array([100.0, 100.0, 300.0, 300.0, 0.0, 0.0, 0.0])
        >>> action = expert(state, goal_state=state)
        >>> action.shape, str(action.dtype)
        ((2,), 'float32')
    """

    def __init__(
        self,
        *,
        rng: np.random.Generator | None = None,
        env: PushTEnv | None = None,
        noise_std: float = 0.05,
        speed: float = 9.0,
        approach_speed: float = 14.0,
        goal_share: float = 0.2,
        random_share: float = 0.15,
        free_share: float = 0.15,
    ) -> None:
        if not 0 <= noise_std < np.inf:
            raise ValueError(f"noise_std must be finite and not negative, got {noise_std}.")
        for name, value in {"speed": speed, "approach_speed": approach_speed}.items():
            if not 0 < value <= 25:
                raise ValueError(f"{name} must be positive and at most 25 px per step, got {value}.")
        shares = {"goal_share": goal_share, "random_share": random_share, "free_share": free_share}
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {share}.")
        self.noise_std = noise_std
        self.speed = speed
        self.approach_speed = approach_speed
        self.goal_share = goal_share
        self.random_share = random_share
        self.free_share = free_share
        self.target: np.ndarray | None = None
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._moves = self._episode()

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state (np.ndarray): [7] float64, see :mod:`~torchrl_ficreg.envs.push_t.geometry`.
            goal_state (np.ndarray): [7] float64; read in the first step only.

        Returns:
            [2] float32 in [-1, 1].
        """
        self._agent, self._pose, velocity = state[:2].copy(), state[2:5].copy(), state[5:7]
        self._goal = goal_state[2:5].copy()
        move = next(self._moves) - self._agent
        length, limit = np.linalg.norm(move), STEP_TIME * np.linalg.norm(velocity) + SPEED_UP
        if length > limit:
            move = move * (limit / length)
        action = move / REACH + self._rng.normal(0.0, self.noise_std, size=2)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    # Each of the following generators yields the wanted position of the disc after the next step, [2] in the window.
    # ``_agent`` and ``_pose`` are up to date whenever it resumes.

    def _episode(self) -> Iterator[np.ndarray]:
        if self._rng.random() < self.goal_share:
            self.target = self._goal
            yield from self._pursue_target(GOAL_PATIENCE)
        while True:
            self.target = self._choose_target()
            yield from self._pursue_target(PATIENCE)
            yield self._agent

    def _pursue_target(self, patience: int) -> Iterator[np.ndarray]:
        steps = 0
        while steps < patience and self._error(self._pose) > REACHED:
            contact, depth = self._choose_push()
            if contact is None:
                return
            steps += 1
            for place in itertools.chain(self._go_around(contact), self._push(contact, depth)):
                steps += 1
                yield place
            if self._rng.random() < self.free_share:
                yield from self._move_freely()

    def _go_around(self, contact: int) -> Iterator[np.ndarray]:
        speed = self._vary(self.approach_speed)
        for _ in range(60):
            if np.linalg.norm(to_window(self._pose, STANDS[contact]) - self._agent) < 5.0:
                return
            yield self._along(Paths(self._pose, self._agent).waypoints(STANDS[contact]), speed)

    def _push(self, contact: int, depth: float | None) -> Iterator[np.ndarray]:
        speed, remaining = self._vary(self.speed), depth
        for _ in range(40):
            gap, offset = self._gap(contact)
            if depth is None:
                remaining = self._best_depth(contact)
            # A large offset: the disc slipped off. A large negative gap: a wall holds the block.
            if remaining <= 0 or abs(offset) > 14 or not -8 < gap < 2 * STAND_OFF:
                return
            advance = min(speed, remaining + max(gap, 0.0))
            into = max(0.0, advance - max(gap, 0.0))
            after = pushed(self._pose, contact, into)
            height = AGENT_RADIUS + max(0.0, gap - advance)
            yield to_window(after, POINTS[contact] - height * NORMALS[contact])
            if depth is not None:
                remaining -= into

    def _move_freely(self) -> Iterator[np.ndarray]:
        place = self._agent + self._rng.uniform(-150, 150, size=2)
        place = np.clip(place, 2 * AGENT_RADIUS, WINDOW - 2 * AGENT_RADIUS)
        speed, rest = self._vary(self.approach_speed), self._rng.integers(0, 8)
        for _ in range(self._rng.integers(3, 20)):
            path = Paths(self._pose, self._agent).waypoints(to_block(self._pose, place))
            if np.linalg.norm(path[-1] - self._agent) < 5.0:
                break
            yield self._along(path, speed)
        for _ in range(rest):
            yield self._agent

    def _along(self, path: list[np.ndarray], length: float) -> np.ndarray:
        """The place [2] that lies ``length`` px along a path from the disc."""
        place = self._agent
        for corner in path:
            leg = np.linalg.norm(corner - place)
            if leg > length:
                return place + (corner - place) * (length / leg)
            place, length = corner, length - leg
        return place

    def _gap(self, contact: int) -> tuple[float, float]:
        """Distance of the disc's edge from the face, and its offset from the contact along the face, in px."""
        offset = to_block(self._pose, self._agent) - POINTS[contact]
        normal = NORMALS[contact]
        return -offset @ normal - AGENT_RADIUS, offset @ np.array([-normal[1], normal[0]])

    def _vary(self, speed: float) -> float:
        return speed * self._rng.uniform(0.6, 1.4)

    def _choose_target(self) -> np.ndarray:
        best, least = self._pose, np.inf
        center = to_window(self._pose, CENTER)
        for _ in range(20):
            heading, turn = self._rng.uniform(0, 2 * np.pi), self._rng.uniform(-1.9, 1.9)
            angle = self._pose[2] + turn
            shift = self._rng.uniform(20, 130) * np.array([np.cos(heading), np.sin(heading)])
            origin = center + shift - rotation(angle) @ CENTER
            pose = np.array([*origin, angle])
            excess = overshoot(pose, 1.5 * BORDER)
            if excess < least:
                best, least = pose, excess
            if excess == 0:
                break
        return best

    def _error(self, poses: np.ndarray) -> np.ndarray:
        """Errors of poses [..., 3] from the target, [...] in px: position, weighted angle and overshoot."""
        angles = poses[..., 2]
        reach = CENTER[1]  # the centre of gravity lies on the block's y axis
        x = poses[..., 0] - reach * np.sin(angles) - self.target[0] + reach * np.sin(self.target[2])
        y = poses[..., 1] + reach * np.cos(angles) - self.target[1] - reach * np.cos(self.target[2])
        turn = TURN_WEIGHT * wrap_angle(angles - self.target[2])
        return np.sqrt(x**2 + y**2 + turn**2) + OVERSHOOT_WEIGHT * overshoot(poses, BORDER)

    def _best_depth(self, contact: int) -> float:
        return float(DEPTHS[self._error(pushed(self._pose, contact, DEPTHS)).argmin()])

    def _choose_push(self) -> tuple[int | None, float | None]:
        """The contact, and the depth of a random push or None; (None, None) where no push reduces the error."""
        stands = to_window(self._pose, STANDS)
        open_ = np.abs(stands - WINDOW / 2).max(-1) < WINDOW / 2 - AGENT_RADIUS
        poses = pushed(self._pose, np.arange(len(POINTS))[:, None], DEPTHS)  # [N, depths, 3]
        if self._rng.random() < self.random_share:
            depth = int(self._rng.integers(4, 14))
            open_ &= overshoot(poses[:, depth], BORDER) <= overshoot(self._pose, BORDER)
            if open_.any():
                return int(self._rng.choice(np.flatnonzero(open_))), float(DEPTHS[depth])
            return None, None
        gain = self._error(self._pose) - self._error(poses)
        steps = Paths(self._pose, self._agent).lengths(STANDS)[:, None] / self.approach_speed + DEPTHS / self.speed
        rate = gain / (steps + 3.0) * np.exp(0.2 * self._rng.normal(size=(len(POINTS), 1)))
        rate[~open_] = -np.inf
        contact = int(rate.max(1).argmax())
        return (contact, None) if gain[contact].max() > 3.0 and open_[contact] else (None, None)


def pushed(pose: np.ndarray, contact: int | np.ndarray, depth: float | np.ndarray) -> np.ndarray:
    """Predicts the pose of the block after a push, by the quasi-static model.

    Args:
        pose (np.ndarray): [3], of the block.
        contact (int or np.ndarray): index or indices of the contact.
        depth (float or np.ndarray): distance that the disc moves along the normal, in px; broadcast against ``contact``.

    Returns:
        [..., 3]; the angle is not wrapped.

    Examples:
        Through the centre of gravity the block follows the disc; at a lever of 52 px it turns:

        >>> pushed(np.array([200.0, 200.0, 0.0]), 6, 10.0).tolist()
        [200.0, 210.0, 0.0]
        >>> pushed(np.array([200.0, 200.0, 0.0]), 12, 10.0).round(2).tolist()
        [203.86, 205.44, 0.09]
    """
    levers, normals = LEVERS[contact], NORMALS[contact]
    share = depth / (1 + levers**2 / RATIO)
    turn = share * levers / RATIO
    # Chord of the arc: half the turn, and shorter than the arc.
    chord = (share * np.sinc(turn / (2 * np.pi)))[..., None] * _turned(normals, pose[2] + turn / 2)
    angle = pose[2] + turn
    center = _turned(CENTER, pose[2]) + pose[:2] + chord
    origin = center - _turned(CENTER, angle)
    return np.concatenate([origin, np.asarray(angle)[..., None]], axis=-1)


def _turned(vectors: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
