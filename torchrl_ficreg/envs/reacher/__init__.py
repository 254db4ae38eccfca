"""Reacher: turn the two joints of a planar arm to the angles of a goal.

* ``env.py``: :class:`ReacherEnv`, which also draws the published pictures: MuJoCo renders dm_control's own scene
* ``render.py``: pictures without GL, close to the published ones
* ``tasks.py``: starts, goals and the success rule
* ``physics.py``: the MuJoCo model
* ``expert.py``: the policies that record data
"""

from __future__ import annotations

from torchrl_ficreg.envs.reacher.env import ReacherEnv
from torchrl_ficreg.envs.reacher.expert import ReacherExpert

__all__ = ["ReacherEnv", "ReacherExpert"]
