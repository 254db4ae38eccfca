"""A pusher that records data: it takes the T from one pose of its own choice to the next."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from torchrl_ficreg.envs.push_t.geometry import (
    CENTER,
    difference,
    leave,
    overshoot,
    Paths,
    rotation,
    to_block,
    to_window,
)
from torchrl_ficreg.envs.push_t.physics import AGENT_RADIUS, BLOCK_MASS, BLOCK_MOMENT, SUBSTEPS, TIME_STEP, WINDOW
if TYPE_CHECKING:
    from torchrl_ficreg.envs.push_t.env import PushTEnv


RATIO = BLOCK_MOMENT / BLOCK_MASS  # px^2
STAND_OFF = 14.0  # px between the disc's edge and the face where an approach ends

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
STANDS = np.stack([leave(place) for place in POINTS - (AGENT_RADIUS + STAND_OFF) * NORMALS])  # [N, 2]


def pushed(pose: np.ndarray, contact: int | np.ndarray, depth: float | np.ndarray) -> np.ndarray:
    """The pose after a push.

    Args:
        pose: [3], of the block.
        contact: index of the contact, or an array of them.
        depth: px that the disc moves along the normal; broadcast against ``contact``.

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


REACH = 40.69  # px per step at which the disc settles under a constant action of 1
STEP_TIME = TIME_STEP * SUBSTEPS  # s
SPEED_UP = 5.0  # px per step that the disc may be faster than in the step before

TURN_WEIGHT = 50.0  # px that a radian of the block's angle is worth
REACHED = 8.0  # px of pose error at which a target is done with
DEPTHS = np.concatenate([np.arange(0.0, 24.0, 3.0), np.arange(24.0, 130.0, 8.0)])  # px, lengths of pushes to choose from
BORDER = 25.0  # px along the walls that the T is kept out of
OVERSHOOT_WEIGHT = 3.0  # px of pose error that a px in the border is worth
PATIENCE, GOAL_PATIENCE = 80, 200  # steps for a target of its own, and for the goal


class PushTExpert:
    """Pushes the T about: target poses, contact faces, ways around the T, and free motion in between.

    A target pose is at most 130 px and 110 degrees away, in the interior of the window. For each push the pusher tries
    all contacts of :mod:`~torchrl_ficreg.envs.push_t.expert` and many depths in the quasi-static model, and takes one
    that brings the block closest for its time, the way around the T included. It approaches with a clearance of 20 px,
    pushes along the normal of the face while it follows the contact point, and corrects itself at each step. Some
    pushes are random ones, and some of the time it strolls or rests. Speeds are drawn anew for every movement.

    One object records one episode: it remembers what it was about to do.

    Args:
        rng: the source of everything random; a fixed one by default, so that equal calls give equal episodes.
        env: not needed; experts are built with the environment they record.
        noise_std: standard deviation of the Gaussian noise on every action component, in actions.
        speed: mean speed of a push, in px per step.
        approach_speed: mean speed of the disc on its ways between pushes, in px per step.
        goal_share: probability that the first target is the block's pose in ``goal_state``.
        random_share: probability that a push is a random one.
        free_share: probability of free motion after a push.

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
        self.target: np.ndarray | None = None  # [3], the block pose it works towards
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._moves = self._live()

    def __call__(self, state: np.ndarray, goal_state: np.ndarray) -> np.ndarray:
        """Chooses the next action.

        Args:
            state: [7] float64, see :mod:`~torchrl_ficreg.envs.push_t.physics`.
            goal_state: [7] float64; looked at in the first step only.

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

    # Each of the following generators yields where the disc should be after the next step, [2] in the window; the
    # state has been read anew whenever it goes on.

    def _live(self) -> Iterator[np.ndarray]:
        if self._rng.random() < self.goal_share:
            self.target = self._goal
            yield from self._work(GOAL_PATIENCE)
        while True:
            self.target = self._choose_target()
            yield from self._work(PATIENCE)
            yield self._agent

    def _work(self, patience: int) -> Iterator[np.ndarray]:
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
                yield from self._stroll()

    def _go_around(self, contact: int) -> Iterator[np.ndarray]:
        speed = self._vary(self.approach_speed)
        for _ in range(60):
            if np.linalg.norm(to_window(self._pose, STANDS[contact]) - self._agent) < 5.0:
                return
            yield self._along(Paths(self._pose, self._agent).waypoints(STANDS[contact]), speed)

    def _push(self, contact: int, depth: float | None) -> Iterator[np.ndarray]:
        speed, remaining = self._vary(self.speed), depth
        for _ in range(40):
            gap, aside = self._gap(contact)
            if depth is None:
                remaining = self._best_depth(contact)
            # Aside: slipped off. Far below the face: the block is held by a wall.
            if remaining <= 0 or abs(aside) > 14 or not -8 < gap < 2 * STAND_OFF:
                return
            advance = min(speed, remaining + max(gap, 0.0))
            into = max(0.0, advance - max(gap, 0.0))
            after = pushed(self._pose, contact, into)
            height = AGENT_RADIUS + max(0.0, gap - advance)
            yield to_window(after, POINTS[contact] - height * NORMALS[contact])
            if depth is not None:
                remaining -= into

    def _stroll(self) -> Iterator[np.ndarray]:
        place = self._agent + self._rng.uniform(-150, 150, size=2)
        place = np.clip(place, 2 * AGENT_RADIUS, WINDOW - 2 * AGENT_RADIUS)
        speed, rest = self._vary(self.approach_speed), self._rng.integers(0, 8)
        for _ in range(self._rng.integers(3, 20)):
            paths = Paths(self._pose, self._agent)
            way = paths.waypoints(to_block(self._pose, place))
            if np.linalg.norm(way[-1] - self._agent) < 5.0:
                break
            yield self._along(way, speed)
        for _ in range(rest):
            yield self._agent

    def _along(self, way: list[np.ndarray], length: float) -> np.ndarray:
        place = self._agent
        for corner in way:
            leg = np.linalg.norm(corner - place)
            if leg > length:
                return place + (corner - place) * (length / leg)
            place, length = corner, length - leg
        return place

    def _gap(self, contact: int) -> tuple[float, float]:
        """Distance of the disc's edge from the face, and how far aside of the contact it is, in px."""
        offset = to_block(self._pose, self._agent) - POINTS[contact]
        normal = NORMALS[contact]
        return -offset @ normal - AGENT_RADIUS, offset @ np.array([-normal[1], normal[0]])

    def _vary(self, speed: float) -> float:
        return speed * self._rng.uniform(0.6, 1.4)

    def _choose_target(self) -> np.ndarray:
        best, least = self._pose, np.inf
        center = to_window(self._pose, CENTER)
        for _ in range(20):
            way, turn = self._rng.uniform(0, 2 * np.pi), self._rng.uniform(-1.9, 1.9)
            angle = self._pose[2] + turn
            shift = self._rng.uniform(20, 130) * np.array([np.cos(way), np.sin(way)])
            origin = center + shift - rotation(angle) @ CENTER
            pose = np.array([*origin, angle])
            excess = overshoot(pose, 1.5 * BORDER)
            if excess < least:
                best, least = pose, excess
            if excess == 0:
                break
        return best

    def _error(self, poses: np.ndarray) -> np.ndarray:
        """How far poses [..., 3] are from the target, in px, [...]."""
        angles = poses[..., 2]
        reach = CENTER[1]  # the centre of gravity lies on the block's y axis
        x = poses[..., 0] - reach * np.sin(angles) - self.target[0] + reach * np.sin(self.target[2])
        y = poses[..., 1] + reach * np.cos(angles) - self.target[1] - reach * np.cos(self.target[2])
        turn = TURN_WEIGHT * difference(angles, self.target[2])
        return np.sqrt(x**2 + y**2 + turn**2) + OVERSHOOT_WEIGHT * overshoot(poses, BORDER)

    def _best_depth(self, contact: int) -> float:
        return float(DEPTHS[self._error(pushed(self._pose, contact, DEPTHS)).argmin()])

    def _choose_push(self) -> tuple[int | None, float | None]:
        """The contact, and the depth of a random push; (None, None) where no push leads closer to the target."""
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
