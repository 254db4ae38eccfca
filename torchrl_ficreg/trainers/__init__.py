"""Offline training on TorchRL's trainer."""

from torchrl_ficreg.trainers.checkpoint import checkpoint_components, find_checkpoint, load_world_model, ModelCard
from torchrl_ficreg.trainers.hooks import MetricsTable, Progress, Validation
from torchrl_ficreg.trainers.offline import OfflineTrainer, WarmupCosine
from torchrl_ficreg.trainers.stepper import OfflineStepper
from torchrl_ficreg.trainers.watch import CoefficientSchedule, LatentAlarm

__all__ = [
    "CoefficientSchedule",
    "LatentAlarm",
    "MetricsTable",
    "ModelCard",
    "OfflineStepper",
    "OfflineTrainer",
    "Progress",
    "Validation",
    "WarmupCosine",
    "checkpoint_components",
    "find_checkpoint",
    "load_world_model",
]
