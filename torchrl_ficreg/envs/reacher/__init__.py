"""Reacher: a planar two-joint arm; its model, environment and expert, each in its own file."""

from __future__ import annotations

from torchrl_ficreg.envs.reacher.env import ReacherEnv
from torchrl_ficreg.envs.reacher.expert import ReacherExpert

__all__ = ["ReacherEnv", "ReacherExpert"]
