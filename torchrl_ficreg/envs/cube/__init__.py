"""Cube: move a cube to another place with a robot arm.

* ``env.py``: :class:`CubeEnv`
* ``tasks.py``: starts, goals and the success rules
* ``physics.py``: OGBench's arm in MuJoCo
* ``render.py``: pictures by MuJoCo, of ``meshes.py``'s simpler meshes
* ``raster.py``: fast pictures, without GL
* ``expert.py``: the policy that records data
"""

from __future__ import annotations

from torchrl_ficreg.envs.cube.env import CubeEnv
from torchrl_ficreg.envs.cube.expert import CubeExpert
from torchrl_ficreg.envs.cube.physics import CubeArm
from torchrl_ficreg.envs.cube.render import render_pixels
from torchrl_ficreg.envs.cube.tasks import cube_angle, sample_goal, sample_start

__all__ = ["CubeArm", "CubeEnv", "CubeExpert", "cube_angle", "render_pixels", "sample_goal", "sample_start"]
