"""The world of PushT: a driven disc and a T that rests unless it is touched, in pymunk.

See :mod:`torchrl_ficreg.envs.push_t.physics` for lengths and axes. Times are in seconds.
"""

from __future__ import annotations

import math
import weakref
from typing import Any

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


try:
    import pymunk
except ImportError as error:
    raise ImportError("PushT needs pymunk: pip install 'torchrl_ficreg[envs]'.") from error


BLOCK_MASS, BLOCK_MOMENT = 1.0, 3000.0

ACTION_SCALE = 100.0  # px of target shift per unit of action
STIFFNESS, DAMPING = 100.0, 20.0  # of the PD law that drives the disc, 1/s^2 and 1/s
TIME_STEP, SUBSTEPS = 0.01, 10  # s, and how many of them make an environment step

MOST_CALLS = 10_000  # that a copy repeats, 2 s; without a restoration there could be any number of them


class PushTWorld:
    """A restorable simulation: the same state and actions give the same bits, whatever happened before.

    A copy or an unpickled world repeats what was done since the last :meth:`set_state`, so that it also has the contacts
    that the solver remembers and goes on with the same bits. After 10,000 calls without one it cannot be copied.

    The disc is kinematic: it pushes the block, nothing pushes it, and walls do not stop it. Space has no friction and
    a damping that stills the block between two contacts.

    State: [7] float64, see :mod:`torchrl_ficreg.envs.push_t.physics`.

    Args:
        relative: an action shifts the target from where the disc is, by 100 px per unit; otherwise it is the target
            itself, in pixels.

    Examples:
        >>> world = PushTWorld()
        >>> world.set_state(np.array([100.0, 100.0, 300.0, 300.0, 0.0, 0.0, 0.0]))
        >>> world.step(np.array([1.0, 0.0]))
        >>> world.get_state()[:2].round(2).tolist()
        [129.57, 100.0]
    """

    def __init__(self, *, relative: bool = True) -> None:
        self.relative = relative
        self._state = np.zeros(STATE_SIZE)
        self._journal: list[tuple[str, np.ndarray]] = []  # calls since the space was built, with their argument
        self._build()
        # pymunk frees a space by Python code, which fails loudly in an interpreter that is being torn down: a world
        # still alive at exit lets go of its space before that.
        weakref.finalize(self, vars(self).clear)

    def __getstate__(self) -> dict[str, Any]:
        # A pymunk space copies neither the centre of gravity nor the solver's memory faithfully.
        if len(self._journal) > MOST_CALLS:
            raise RuntimeError(
                f"a PushT scene that was stepped more than {MOST_CALLS} times since its last set_state() cannot be copied: "
                "reset it first."
            )
        return {"relative": self.relative, "journal": self._journal}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(relative=state["relative"])
        for method, argument in state["journal"]:
            getattr(self, method)(argument)

    def _build(self) -> None:
        self._journal.clear()
        # Contacts cached by the solver and the order of its collision pairs are hidden state that pymunk cannot
        # clear: a new space (0.1 ms) is the only restoration that is exact.
        self.space = pymunk.Space()
        self.space.gravity = (0.0, 0.0)
        self.space.damping = 0.0
        corners = [(WALL_LOW, WALL_HIGH), (WALL_LOW, WALL_LOW), (WALL_HIGH, WALL_LOW), (WALL_HIGH, WALL_HIGH)]
        walls = [
            pymunk.Segment(self.space.static_body, corners[i], corners[(i + 1) % 4], WALL_RADIUS) for i in range(4)
        ]
        self.agent = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.block = pymunk.Body(BLOCK_MASS, BLOCK_MOMENT)
        self.block.center_of_gravity = CENTER_OF_GRAVITY
        self.space.add(*walls)
        self.space.add(self.agent, pymunk.Circle(self.agent, AGENT_RADIUS))
        self.space.add(self.block, pymunk.Poly(self.block, BAR), pymunk.Poly(self.block, STEM))

    def _note(self, method: str, argument: np.ndarray) -> None:
        if len(self._journal) <= MOST_CALLS:
            self._journal.append((method, argument.copy()))

    def set_state(self, state: np.ndarray) -> None:
        """Restores a state [7] without a physics step."""
        self._build()
        self._note("set_state", state)
        self._place(state)
        self._state = state.copy()

    def restore_legacy(self, state: np.ndarray) -> None:
        """Restores a state [7] as the published environment does: in the running space, with one physics step.

        The agent is carried on by its velocity, and what overlapped before the restoration pushes the block after it.
        """
        self._note("restore_legacy", state)
        self._place(state)
        self.space.step(TIME_STEP)
        self._read()

    def _place(self, state: np.ndarray) -> None:
        x, y, block_x, block_y, angle, velocity_x, velocity_y = state.tolist()
        self.agent.velocity = (velocity_x, velocity_y)
        self.agent.position = (x, y)
        self.block.angle = angle  # before the position: setting it turns the block about its centre of gravity
        self.block.position = (block_x, block_y)

    def get_state(self) -> np.ndarray:
        """The state [7], a copy."""
        return self._state.copy()

    def step(self, action: np.ndarray) -> None:
        """Drives the disc for 0.1 s.

        Args:
            action: [2] float64, not clipped.
        """
        action = np.asarray(action, dtype=np.float64)
        self._note("step", action)
        target = action * ACTION_SCALE + self._state[:2] if self.relative else action
        target_x, target_y = float(target[0]), float(target[1])
        agent = self.agent
        for _ in range(SUBSTEPS):
            (x, y), (velocity_x, velocity_y) = agent.position, agent.velocity
            velocity_x += (STIFFNESS * (target_x - x) - DAMPING * velocity_x) * TIME_STEP
            velocity_y += (STIFFNESS * (target_y - y) - DAMPING * velocity_y) * TIME_STEP
            agent.velocity = (velocity_x, velocity_y)
            self.space.step(TIME_STEP)
        self._read()

    def _read(self) -> None:
        self._state = np.array(
            [
                *self.agent.position,
                *self.block.position,
                wrap(self.block.angle),
                *self.agent.velocity,
            ]
        )
