"""Losses: who receives gradient, and from what."""

from torchrl_ficreg.objectives.ficreg import FICRegLoss
from torchrl_ficreg.objectives.flow import gradient_flow
from torchrl_ficreg.objectives.lewm import LeWMLoss
from torchrl_ficreg.objectives.sigreg import SIGReg

__all__ = ["FICRegLoss", "LeWMLoss", "SIGReg", "gradient_flow"]
