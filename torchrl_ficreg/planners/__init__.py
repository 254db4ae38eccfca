"""Search for action sequences in latent space: dynamics x cost x search."""

from __future__ import annotations

from torchrl_ficreg.planners.base import LatentPlanner
from torchrl_ficreg.planners.config import GradientConfig, ICEMConfig, MPPIConfig, PlanConfig
from torchrl_ficreg.planners.costs import ActionEffort, CostSum, GoalDistance, InverseConsistency, PathDistance
from torchrl_ficreg.planners.goal_policy import PolicyPlanner
from torchrl_ficreg.planners.gradient import GradientPlanner
from torchrl_ficreg.planners.latent_env import LatentGoalEnv
from torchrl_ficreg.planners.mpc import MPCPolicy
from torchrl_ficreg.planners.sampling import (
    LatentCEMPlanner,
    LatentICEMPlanner,
    LatentMPPIPlanner,
    RandomShooting,
    SamplingPlanner,
)

SEARCHES: dict[str, type[LatentPlanner]] = {
    "cem": LatentCEMPlanner,
    "icem": LatentICEMPlanner,
    "mppi": LatentMPPIPlanner,
    "gradient": GradientPlanner,
    "shooting": RandomShooting,
    "policy": PolicyPlanner,
}

__all__ = [
    "ActionEffort",
    "CostSum",
    "GoalDistance",
    "GradientConfig",
    "GradientPlanner",
    "ICEMConfig",
    "InverseConsistency",
    "LatentCEMPlanner",
    "LatentGoalEnv",
    "LatentICEMPlanner",
    "LatentMPPIPlanner",
    "LatentPlanner",
    "MPCPolicy",
    "MPPIConfig",
    "PathDistance",
    "PlanConfig",
    "PolicyPlanner",
    "RandomShooting",
    "SamplingPlanner",
    "SEARCHES",
]
