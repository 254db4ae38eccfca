"""What one training step costs: operations of its matrix products, and the rate a device can do them at."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from torchrl_ficreg.modules import kernels, transformer
from torchrl_ficreg.trainers import OfflineTrainer


def take_step(trainer: OfflineTrainer, clip: TensorDictBase) -> None:
    """Forward, backward, clipping and update, as in training and without its bookkeeping.

    Args:
        trainer: whose networks are moved.
        clip: [B, T] on the trainer's device.
    """
    trainer.optimization_stepper.step(trainer, clip)


def operations_of_step(trainer: OfflineTrainer, clip: TensorDictBase) -> int:
    """Additions and multiplications of all matrix products of one step, forward and backward."""
    with without_cpu_kernels(), _Counter() as counter:
        take_step(trainer, clip)
    return counter.operations


@contextmanager
def without_cpu_kernels(*, fused: bool = False) -> Iterator[None]:
    """Layers as a GPU runs them: what the package does to save time on CPUs would be counted as work.

    Args:
        fused: attention by torch's fused kernel, whose products cannot be counted, and which keeps no weights.
    """

    def attend(query, key, value, causal, dropout=0.0):
        return F.scaled_dot_product_attention(query, key, value, is_causal=causal, dropout_p=dropout)

    with (
        patch.object(kernels, "trains_on_cpu", lambda x: False),
        patch.object(transformer, "suits_packed_attention", lambda x: False),
        patch.object(transformer, "attend", attend if fused else transformer.attend),
    ):
        yield


class _Counter(TorchDispatchMode):
    """Counts by torch's own formulas; its FlopCounterMode asks every module for its truth, which a tensordict refuses."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        formula = flop_registry.get(func._overloadpacket)
        if formula is not None:
            self.operations += formula(*args, **(kwargs or {}), out_val=result)
        return result


def state_bytes(trainer: OfflineTrainer) -> int:
    """Bytes of what training keeps from step to step: weights, gradients and the optimiser's two moments."""
    return sum(4 * p.numel() * p.element_size() for p in trainer.loss_module.parameters() if p.requires_grad)


def matrix_rate(device: torch.device, dtype: torch.dtype = torch.bfloat16, size: int = 2048, repeats: int = 20) -> float:
    """Operations per second of a large matrix product of random numbers, the best of a few.

    Args:
        device: where.
        dtype: of the factors.
        size: rows and columns; 8192 fills a large GPU.
        repeats: how many.
    """
    a, b = torch.randn(2, size, size, device=device).to(dtype)
    return 2 * size**3 / min(seconds(lambda: a @ b, device) for _ in range(repeats))


def seconds(function: Callable[[], object], device: torch.device) -> float:
    """Wall time of a call, what it leaves running on the device included."""
    wait_for(device)
    began = time.perf_counter()
    function()
    wait_for(device)
    return time.perf_counter() - began


def wait_for(device: torch.device) -> None:
    """Until the device has done all it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
