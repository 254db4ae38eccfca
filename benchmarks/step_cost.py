"""Cost of a training step: operations of its matrix products, and a device's rate for them."""

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

from torchrl_ficreg.modules import transformer
from torchrl_ficreg.trainers import OfflineTrainer


def take_step(trainer: OfflineTrainer, clip: TensorDictBase) -> None:
    """Forward, backward, clipping and update, as in training and without its bookkeeping.

    Args:
        trainer: its networks are updated.
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
    """Attention as a GPU computes it, so that operations and memory do not depend on the processor at hand.

    Args:
        fused: by torch's fused kernel also on CPUs, where its products cannot be counted; it keeps no weights.
    """

    def attend(query, key, value, causal, dropout=0.0):
        if query.device.type == "cpu" and not fused:
            return transformer.attend_by_products(query, key, value, causal, dropout)
        return F.scaled_dot_product_attention(query, key, value, is_causal=causal, dropout_p=dropout)

    with patch.object(transformer, "attend", attend):
        yield


class _Counter(TorchDispatchMode):
    """Counts by torch's own formulas. Its FlopCounterMode evaluates ``bool(output)``, which a tensordict does not support."""

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
    """Bytes that training keeps between steps: weights, gradients and the optimizer state (two numbers for each weight)."""
    return sum(4 * p.numel() * p.element_size() for p in trainer.loss_module.parameters() if p.requires_grad)


def matrix_rate(device: torch.device, dtype: torch.dtype = torch.bfloat16, size: int = 2048, repeats: int = 20) -> float:
    """Operations per second of a large matrix product of random numbers, the best of a few.

    Args:
        device: device of the matrices.
        dtype: dtype of the matrices.
        size: number of rows and columns; 8192 saturates a large GPU.
        repeats: number of products.
    """
    a, b = torch.randn(2, size, size, device=device).to(dtype)
    return 2 * size**3 / min(seconds(lambda: a @ b, device) for _ in range(repeats))


def seconds(function: Callable[[], object], device: torch.device) -> float:
    """Wall time of a call, with the asynchronous work that it starts on the device."""
    wait_for(device)
    began = time.perf_counter()
    function()
    wait_for(device)
    return time.perf_counter() - began


def wait_for(device: torch.device) -> None:
    """Waits until the device has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
