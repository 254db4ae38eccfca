"""TwoRoom: move a disc through a door to a goal in the other room.

* ``env.py``: :class:`TwoRoomEnv`
* ``tasks.py``: starts, goals and the success rule
* ``physics.py``: the scene and how a step ends at walls
* ``render.py``: pictures
* ``expert.py``: the policy that records data
"""

from __future__ import annotations

from torchrl_ficreg.envs.two_room.env import TwoRoomEnv
from torchrl_ficreg.envs.two_room.expert import TwoRoomExpert
from torchrl_ficreg.envs.two_room.physics import TWO_ROOM, TwoRoomGeometry
from torchrl_ficreg.envs.two_room.render import render_pixels
from torchrl_ficreg.envs.two_room.tasks import sample_task

__all__ = ["TWO_ROOM", "TwoRoomEnv", "TwoRoomExpert", "TwoRoomGeometry", "render_pixels", "sample_task"]
