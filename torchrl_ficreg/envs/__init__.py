"""Goal-conditioned environments with pictures, restorable states and experts.

Importing this package registers the Gymnasium ids and loads no simulator. Each environment is a folder of the same
files: ``env.py``, ``tasks.py`` (starts, goals, success rule), ``physics.py``, ``render.py`` and ``expert.py``.
"""

from __future__ import annotations

from torchrl_ficreg.envs.base import PixelGoalEnv
from torchrl_ficreg.envs.collect import collect_episodes, collect_on_ray
from torchrl_ficreg.envs.make import make_env
from torchrl_ficreg.envs.registry import EnvEntry, ENVIRONMENTS, Expert, register_all

register_all()

__all__ = ["ENVIRONMENTS", "EnvEntry", "Expert", "PixelGoalEnv", "collect_episodes", "collect_on_ray", "make_env"]
