"""Physics of PushT: a driven disc and a T that rests unless it is touched, simulated by pymunk.

Lengths and the state's layout are those of :mod:`torchrl_ficreg.envs.push_t.geometry`; times are in seconds.
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from torchrl_ficreg._utils import require
from torchrl_ficreg.envs._angles import wrap_angle
from torchrl_ficreg.envs.push_t.geometry import (
    AGENT_RADIUS,
    BAR,
    CENTER_OF_GRAVITY,
    STATE_SIZE,
    STEM,
    WALL_HIGH,
    WALL_LOW,
    WALL_RADIUS,
)

pymunk = require("pymunk", "envs", purpose="PushT")

BLOCK_MASS, BLOCK_MOMENT = 1.0, 3000.0
ACTION_SCALE = 100.0  # px of target shift per unit of action
STIFFNESS, DAMPING = 100.0, 20.0  # of the PD law that drives the disc, 1/s^2 and 1/s
TIME_STEP, SUBSTEPS = 0.01, 10  # s, and how many of them make an environment step
MOST_CALLS = 10_000  # that a copy repeats, 2 s


class PushTWorld:
    """A restorable simulation: the same state and actions give the same bits, whatever happened before.

    A copied or unpickled world repeats the calls since the last :meth:`set_state`, so that its solver holds the same
    cached contacts and its next steps have the same bits. After 10,000 calls without a :meth:`set_state`, copying raises
    ``RuntimeError``.

    The disc is kinematic: it pushes the block, and neither the block nor the walls act on it. There is no friction, and
    the damping stops the block as soon as it is not touched.

    The state, [7] float64, is laid out in :mod:`torchrl_ficreg.envs.push_t.geometry`.

    Args:
        relative (bool, optional): whether an action shifts the disc's target from its present position, by 100 px per
            unit; otherwise the action is the target itself, in pixels. Default: ``True``.

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
        # pymunk frees a space by Python code, which prints an exception when the interpreter is being finalized: a
        # world still alive at exit drops its space earlier.
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

        The agent moves by one step of its velocity, and an overlap from before the restoration still pushes the block.
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
        """Returns a copy of the state, [7] float64."""
        return self._state.copy()

    def step(self, action: np.ndarray) -> None:
        """Drives the disc for 0.1 s.

        Args:
            action (np.ndarray): [2] float64, not clipped.
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
                wrap_angle(self.block.angle, low=0.0),
                *self.agent.velocity,
            ]
        )
