"""Networks as TensorDictModules, and the world model made of them."""

from torchrl_ficreg.modules.config import make_world_model, ModelConfig
from torchrl_ficreg.modules.conv import ConvEncoder
from torchrl_ficreg.modules.goal_policy import GoalPolicy
from torchrl_ficreg.modules.inverse import InverseDynamicsModel
from torchrl_ficreg.modules.keypoints import KeypointEncoder
from torchrl_ficreg.modules.predictor import ActionEncoder, CausalPredictor
from torchrl_ficreg.modules.vit import ViTEncoder
from torchrl_ficreg.modules.world_model import LatentWorldModel

__all__ = [
    "ActionEncoder",
    "CausalPredictor",
    "ConvEncoder",
    "GoalPolicy",
    "InverseDynamicsModel",
    "KeypointEncoder",
    "LatentWorldModel",
    "ModelConfig",
    "ViTEncoder",
    "make_world_model",
]
