"""Losses of world models, their terms, and diagnostics of gradients and latents."""

from torchrl_ficreg.objectives.diagnostics import gradient_flow, latent_health, LatentHealth
from torchrl_ficreg.objectives.ficreg import FICRegLoss
from torchrl_ficreg.objectives.joint_inverse import JointInverseLoss
from torchrl_ficreg.objectives.lewm import LeWMLoss
from torchrl_ficreg.objectives.pldm import PLDMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg
from torchrl_ficreg.objectives.terms import CovariancePenalty, TemporalStraightness, VarianceHinge

__all__ = [
    "CovariancePenalty",
    "FICRegLoss",
    "JointInverseLoss",
    "LatentHealth",
    "LeWMLoss",
    "PLDMLoss",
    "SIGReg",
    "TemporalStraightness",
    "VarianceHinge",
    "gradient_flow",
    "latent_health",
]
