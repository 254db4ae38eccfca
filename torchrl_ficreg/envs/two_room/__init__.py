"""TwoRoom: dynamics, pictures, tasks, expert and environment, each in its own file."""

from __future__ import annotations

from torchrl_ficreg.envs.two_room.env import TwoRoomEnv
from torchrl_ficreg.envs.two_room.expert import TwoRoomExpert
from torchrl_ficreg.envs.two_room.physics import TWO_ROOM, TwoRoomGeometry
from torchrl_ficreg.envs.two_room.render import render
from torchrl_ficreg.envs.two_room.tasks import sample_task

__all__ = ["TWO_ROOM", "TwoRoomEnv", "TwoRoomExpert", "TwoRoomGeometry", "render", "sample_task"]
