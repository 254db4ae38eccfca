"""Latent world models to plan with, for TorchRL."""

from torchrl_ficreg import _mujoco  # isort: skip # noqa: F401 (before TorchRL)
from torchrl_ficreg.modules import *  # noqa: F401, F403
from torchrl_ficreg.objectives import *  # noqa: F401, F403
