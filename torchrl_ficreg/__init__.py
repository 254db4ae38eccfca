"""Latent world models to plan with, for TorchRL."""

from torchrl_ficreg.modules import *  # noqa: F401, F403
from torchrl_ficreg.objectives import *  # noqa: F401, F403
