"""Cube: a robot arm and a cube; simulator, meshes, pictures, tasks, expert and environment, each in its own file."""

from __future__ import annotations

from torchrl_ficreg.envs.cube.env import CubeEnv
from torchrl_ficreg.envs.cube.expert import CubeExpert
from torchrl_ficreg.envs.cube.physics import CubeArm
from torchrl_ficreg.envs.cube.render import render
from torchrl_ficreg.envs.cube.tasks import cube_angle, sample_goal, sample_start

__all__ = ["CubeArm", "CubeEnv", "CubeExpert", "cube_angle", "render", "sample_goal", "sample_start"]
