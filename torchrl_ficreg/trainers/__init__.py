"""Offline training on TorchRL's trainer."""

from torchrl_ficreg.trainers.checkpoint import checkpoint_components, find_checkpoint, load_world_model, ModelCard
from torchrl_ficreg.trainers.hooks import MetricsTable, Progress, Validation
from torchrl_ficreg.trainers.offline import OfflineTrainer
from torchrl_ficreg.trainers.refinement import LatentsAsFrames, NoRegularizer, on_frozen_latents, Refinement
from torchrl_ficreg.trainers.schedule import WarmupCosine
from torchrl_ficreg.trainers.stepper import OfflineStepper
from torchrl_ficreg.trainers.watch import CoefficientSchedule, LatentAlarm

__all__ = [
    "CoefficientSchedule",
    "LatentAlarm",
    "LatentsAsFrames",
    "MetricsTable",
    "ModelCard",
    "NoRegularizer",
    "OfflineStepper",
    "OfflineTrainer",
    "Progress",
    "Refinement",
    "Validation",
    "WarmupCosine",
    "checkpoint_components",
    "find_checkpoint",
    "load_world_model",
    "on_frozen_latents",
]
