"""Names of all tensordict entries, with their shapes and units.

Every module of the package takes these names as defaults. A *stored step* is one row of an episode on disk; a *clip* is a
sub-trajectory of T frames, F environment steps apart. Leading batch dimensions are left out.
"""

from __future__ import annotations

# Stored steps, environments and clips

PIXELS = "pixels"  # [3, H, W] uint8, the frame before the action; in clips [T, 3, H, W]
# In stored steps, environments and what MPCPolicy writes: one action [A] float32 in environment units, zero at the last
# step of an episode. In clips, losses, world models and planners: a z-scored block [F * A] of the F actions that lead from
# one frame to the next.
ACTION = "action"
STATE = "state"  # [S] float64, enough to restore the simulator exactly
EPISODE = "episode"  # [] int64, from 1, so that an unwritten row (0) is recognisable
STEP = "step"  # [] int64, from 0
DONE = ("next", "done")  # [1] bool, last step of its episode
MASK = "mask"  # clips only: [T] bool, false where an action block leaves its episode
GOAL_PIXELS = "goal_pixels"  # [3, H, W] uint8
GOAL_STATE = "goal_state"  # [S] float64, the state to reach
SUCCESS = "success"  # [1] bool

# Networks

LATENT = "latent"  # [D], or [T, D]
PREDICTED_LATENT = "predicted_latent"  # [T, D]; row t predicts the latent after that of row t
NEXT_LATENT = "next_latent"  # [T, D], what the inverse dynamics model reads; ("next", "latent") is the same
GOAL_LATENT = "goal_latent"  # [D]
RECOVERED_ACTION = "recovered_action"  # [F * A], z-scored, as the inverse dynamics model recovers it
ACTION_EMBEDDING = "action_embedding"  # [width], by an ActionEncoder

# Planning: E environments, C context frames, N = horizon action blocks, F raw actions of A components in a block.

PLAN = "plan"  # [E, N, F * A] float, z-scored
PLAN_COST = "plan_cost"  # [E] float32 or float64, in units of the cost
PLAN_SEED = "plan_seed"  # [E] int64, identifies the random draws of an environment
TRACE = "trace"  # tensordict with best_cost, elite_cost (units of the cost) and std (z-scored actions), each [E, iterations]
PAST_ACTION = "past_action"  # [E, C - 1, F * A] float, z-scored, executed between the context frames
PAST_LATENT = "past_latent"  # [..., H - 1, D] float, imagined so far, zeros before the start
PAST_LENGTH = "past_length"  # [..., 1] int64, how many rows of past_latent and past_action are filled
MPC_MEMORY = "mpc"  # tensordict in which MPCPolicy keeps its queue of raw actions and its last plan
IS_INIT = "is_init"  # [E, 1] bool, true at the first step of an episode; TorchRL's InitTracker writes it

# Inverse dynamics models: how certain they are of RECOVERED_ACTION

RECOVERED_ACTION_LOG_VAR = "recovered_action_log_var"  # [..., F * A], z-scored; of a Gaussian head
RECOVERED_ACTION_VARIANCE = "recovered_action_variance"  # [..., F * A], z-scored; among the members of an ensemble
