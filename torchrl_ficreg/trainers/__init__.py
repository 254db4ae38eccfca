"""Offline training on TorchRL's trainer."""

from torchrl_ficreg.trainers.checkpoint import checkpoint_components, find_checkpoint, load_world_model
from torchrl_ficreg.trainers.hooks import (
    CoefficientSchedule,
    CollapseMonitor,
    EvaluationHook,
    MetricsTable,
    Progress,
    Throughput,
    Validation,
)
from torchrl_ficreg.trainers.loggers import PhaseLogger, TolerantLogger
from torchrl_ficreg.trainers.offline import OfflineTrainer, WarmupCosine
from torchrl_ficreg.trainers.refinement import Refinement
from torchrl_ficreg.trainers.signals import exit_on_signal, Preempted, PREEMPTED, stop_on_signal
from torchrl_ficreg.trainers.stepper import OfflineStepper
from torchrl_ficreg.trainers.stream import ClipBuffer, ReadError

__all__ = [
    "ClipBuffer",
    "CoefficientSchedule",
    "CollapseMonitor",
    "EvaluationHook",
    "MetricsTable",
    "OfflineStepper",
    "OfflineTrainer",
    "PREEMPTED",
    "PhaseLogger",
    "Preempted",
    "Progress",
    "ReadError",
    "Refinement",
    "Throughput",
    "TolerantLogger",
    "Validation",
    "WarmupCosine",
    "checkpoint_components",
    "exit_on_signal",
    "find_checkpoint",
    "load_world_model",
    "stop_on_signal",
]
