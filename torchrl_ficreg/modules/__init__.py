"""Networks as TensorDictModules, the world model made of them, and planners on top of it."""

from torchrl_ficreg.modules.conv import ConvEncoder
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.goal_policy import GoalPolicy
from torchrl_ficreg.modules.keypoints import KeypointEncoder
from torchrl_ficreg.modules.planners import (
    ActionEffort,
    CostSum,
    GoalDistance,
    GradientConfig,
    GradientPlanner,
    ICEMConfig,
    InverseConsistency,
    LatentCEMPlanner,
    LatentGoalEnv,
    LatentICEMPlanner,
    LatentMPPIPlanner,
    LatentPlanner,
    MPCPolicy,
    MPPIConfig,
    PathDistance,
    PlanConfig,
    PolicyPlanner,
    RandomShooting,
)
from torchrl_ficreg.modules.predictor import ActionEncoder, CausalPredictor
from torchrl_ficreg.modules.presets import make_world_model, ModelConfig
from torchrl_ficreg.modules.vit import ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel

__all__ = [
    "ActionEffort",
    "ActionEncoder",
    "CausalPredictor",
    "ConvEncoder",
    "CostSum",
    "GoalDistance",
    "GoalPolicy",
    "GradientConfig",
    "GradientPlanner",
    "ICEMConfig",
    "InverseConsistency",
    "InverseDynamicsModel",
    "KeypointEncoder",
    "LatentCEMPlanner",
    "LatentGoalEnv",
    "LatentICEMPlanner",
    "LatentMPPIPlanner",
    "LatentPlanner",
    "LatentWorldModel",
    "MPCPolicy",
    "MPPIConfig",
    "ModelConfig",
    "PathDistance",
    "PlanConfig",
    "PolicyPlanner",
    "RandomShooting",
    "ViTEncoder",
    "make_world_model",
]
