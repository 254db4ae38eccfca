"""Search for action sequences in latent space: dynamics x cost x search."""

from __future__ import annotations

from torchrl_ficreg.modules.planners.cem import LatentCEMPlanner
from torchrl_ficreg.modules.planners.common import LatentPlanner
from torchrl_ficreg.modules.planners.config import GradientConfig, ICEMConfig, MPPIConfig, PlanConfig
from torchrl_ficreg.modules.planners.costs import ActionEffort, CostSum, GoalDistance, InverseConsistency, PathDistance
from torchrl_ficreg.modules.planners.gradient import GradientPlanner
from torchrl_ficreg.modules.planners.icem import LatentICEMPlanner
from torchrl_ficreg.modules.planners.latent_env import LatentGoalEnv
from torchrl_ficreg.modules.planners.mpc import MPCPolicy
from torchrl_ficreg.modules.planners.mppi import LatentMPPIPlanner
from torchrl_ficreg.modules.planners.policy import PolicyPlanner
from torchrl_ficreg.modules.planners.sampling import SamplingPlanner
from torchrl_ficreg.modules.planners.shooting import RandomShooting

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
