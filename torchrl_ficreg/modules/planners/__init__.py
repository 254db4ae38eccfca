"""Search for action sequences in latent space: dynamics x cost x search."""

from torchrl_ficreg.modules.planners.cem import LatentCEMPlanner
from torchrl_ficreg.modules.planners.common import LatentPlanner, PlanConfig
from torchrl_ficreg.modules.planners.costs import GoalDistance
from torchrl_ficreg.modules.planners.mpc import MPCPolicy

__all__ = ["GoalDistance", "LatentCEMPlanner", "LatentPlanner", "MPCPolicy", "PlanConfig"]
