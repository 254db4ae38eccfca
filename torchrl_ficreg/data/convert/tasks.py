"""Which columns of foreign files hold the state of each environment."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TaskColumns:
    """What a file has to hold for one environment.

    Attributes:
        states: candidates in order of preference; each is a list of columns that are joined.
        state_dim: S.
        action_dim: A. Every component of these environments' actions is bounded by -1 and 1.
    """

    states: tuple[tuple[str, ...], ...]
    state_dim: int
    action_dim: int


TASKS: dict[str, TaskColumns] = {
    "two_room": TaskColumns((("state",), ("pos_agent",), ("proprio",)), state_dim=2, action_dim=2),
    "push_t": TaskColumns((("state",),), state_dim=7, action_dim=2),
    "reacher": TaskColumns((("qpos", "qvel"),), state_dim=4, action_dim=2),
    "cube": TaskColumns((("qpos", "qvel"),), state_dim=41, action_dim=5),
}

# For any other data. The simulator's own coordinates come first: they are what restores it.
OTHER_STATES = (("state",), ("qpos", "qvel"), ("observation.state",), ("observation",), ("observations",))
OTHER_PIXELS = ("pixels", "observations", "observation.image", "image")
OTHER_ACTIONS = ("action", "actions")
