"""Planning in latent space: dynamics, cost and search; and model-predictive control with the plans."""

from __future__ import annotations

from torchrl_ficreg.planners.base import LatentPlanner
from torchrl_ficreg.planners.cem import CEMConfig, LatentCEMPlanner, SamplingPlanner
from torchrl_ficreg.planners.config import PlanConfig
from torchrl_ficreg.planners.costs import (
    ActionEffort,
    CostSum,
    GoalDistance,
    InverseConsistency,
    PathDistance,
    StayDistance,
)
from torchrl_ficreg.planners.goal_policy import GoalPolicyPlanner
from torchrl_ficreg.planners.gradient import GradientConfig, GradientPlanner
from torchrl_ficreg.planners.latent_env import LatentGoalEnv
from torchrl_ficreg.planners.mpc import MPCPolicy
from torchrl_ficreg.planners.sampling import (
    ICEMConfig,
    LatentICEMPlanner,
    LatentMPPIPlanner,
    MPPIConfig,
    RandomShooting,
    ShootingConfig,
)

SEARCHES: dict[str, type[LatentPlanner]] = {
    "cem": LatentCEMPlanner,
    "icem": LatentICEMPlanner,
    "mppi": LatentMPPIPlanner,
    "gradient": GradientPlanner,
    "shooting": RandomShooting,
    "policy": GoalPolicyPlanner,
}  # by their names in the scripts' configuration

__all__ = [
    "ActionEffort",
    "CEMConfig",
    "CostSum",
    "GoalDistance",
    "GoalPolicyPlanner",
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
    "RandomShooting",
    "SEARCHES",
    "SamplingPlanner",
    "ShootingConfig",
    "StayDistance",
]
