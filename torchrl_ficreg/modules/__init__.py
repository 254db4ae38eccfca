"""Networks as TensorDictModules, the world model made of them, and planners on top of it."""

from torchrl_ficreg.modules.conv import ConvEncoder
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.keypoints import KeypointEncoder
from torchrl_ficreg.modules.planners import GoalDistance, LatentCEMPlanner, LatentPlanner, MPCPolicy, PlanConfig
from torchrl_ficreg.modules.predictor import ActionEncoder, CausalPredictor
from torchrl_ficreg.modules.presets import make_world_model, ModelConfig
from torchrl_ficreg.modules.vit import ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel

__all__ = [
    "ActionEncoder",
    "CausalPredictor",
    "ConvEncoder",
    "GoalDistance",
    "InverseDynamicsModel",
    "KeypointEncoder",
    "LatentCEMPlanner",
    "LatentPlanner",
    "LatentWorldModel",
    "MPCPolicy",
    "ModelConfig",
    "PlanConfig",
    "ViTEncoder",
    "make_world_model",
]
