"""Goal-conditioned environments with pictures, restorable states and experts.

Importing this package registers the Gymnasium ids and loads no simulator.
"""

from __future__ import annotations

from torchrl_ficreg.envs.base import GoalEnv
from torchrl_ficreg.envs.collect import collect_episodes
from torchrl_ficreg.envs.make import make_env
from torchrl_ficreg.envs.registry import EnvEntry, ENVIRONMENTS, Expert, register_all

register_all()

__all__ = ["ENVIRONMENTS", "EnvEntry", "Expert", "GoalEnv", "collect_episodes", "make_env"]
