"""Offline training on TorchRL's trainer."""

from torchrl_ficreg.trainers.checkpoint import checkpoint_components, find_checkpoint, load_world_model
from torchrl_ficreg.trainers.hooks import (
    CoefficientSchedule,
    LatentAlarm,
    Meter,
    MetricsTable,
    Progress,
    SuccessRate,
    Validation,
)
from torchrl_ficreg.trainers.loggers import TolerantLogger
from torchrl_ficreg.trainers.offline import OfflineTrainer, WarmupCosine
from torchrl_ficreg.trainers.refinement import LatentsAsFrames, NoRegularizer, on_frozen_latents, Refinement
from torchrl_ficreg.trainers.signals import exit_on_signal, Preempted, PREEMPTED, stop_on_signal
from torchrl_ficreg.trainers.stepper import OfflineStepper
from torchrl_ficreg.trainers.stream import ReadError

__all__ = [
    "CoefficientSchedule",
    "LatentAlarm",
    "LatentsAsFrames",
    "Meter",
    "MetricsTable",
    "NoRegularizer",
    "OfflineStepper",
    "OfflineTrainer",
    "PREEMPTED",
    "Preempted",
    "Progress",
    "ReadError",
    "Refinement",
    "SuccessRate",
    "TolerantLogger",
    "Validation",
    "WarmupCosine",
    "checkpoint_components",
    "exit_on_signal",
    "find_checkpoint",
    "load_world_model",
    "on_frozen_latents",
    "stop_on_signal",
]
