"""The key contract: the only names that travel between collection, training and planning.

A *stored step* is one row of an episode on disk; a *clip* is a strided sub-trajectory cut out of it.
Every module of the package takes these names as defaults and none of them invents another.
"""

from __future__ import annotations

PIXELS = "pixels"  # [3, H, W] uint8, the frame before the action
ACTION = "action"  # [A] float32, environment units; zero at the last step, where no action was taken
STATE = "state"  # [S] float64, enough to restore the simulator exactly
EPISODE = "episode"  # [] int64, from 1, so that an unwritten row (0) is recognisable
STEP = "step"  # [] int64, from 0
DONE = ("next", "done")  # [1] bool, last step of its episode
MASK = "mask"  # clip only: [B, T] bool, false where an action block leaves its episode

LATENT = "latent"
PREDICTED_LATENT = "predicted_latent"
RECOVERED_ACTION = "recovered_action"
GOAL_LATENT = "goal_latent"
GOAL_PIXELS = "goal_pixels"
SUCCESS = "success"
