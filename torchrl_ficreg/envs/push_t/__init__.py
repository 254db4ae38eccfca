"""PushT: push a T-shaped block to the position and angle of a goal.

* ``env.py``: :class:`~torchrl_ficreg.envs.push_t.env.PushTEnv`
* ``tasks.py``: starts, goals and the success rule
* ``physics.py``: the pymunk simulation
* ``render.py``: pictures
* ``expert.py``: the policy that records data
* ``geometry.py``: sizes of the bodies, the frame of the T, paths around it

``env``, ``physics`` and ``expert`` import pymunk and are therefore not imported here; the others need no simulator.
"""

from __future__ import annotations

from torchrl_ficreg.envs.push_t.render import render_pixels
from torchrl_ficreg.envs.push_t.tasks import sample_state

__all__ = ["render_pixels", "sample_state"]
