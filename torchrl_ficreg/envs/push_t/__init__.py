"""PushT: push a T-shaped block to the place and angle seen in an image.

Pictures and draws need no simulator; ``PushTEnv`` and ``PushTWorld`` live in modules that import pymunk:
:mod:`torchrl_ficreg.envs.push_t.env` and :mod:`torchrl_ficreg.envs.push_t.physics`.
"""

from __future__ import annotations

from torchrl_ficreg.envs.push_t.render import render
from torchrl_ficreg.envs.push_t.tasks import sample_state

__all__ = ["render", "sample_state"]
