"""Numeric precision, chosen by what the device is good at."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Literal

import torch

Precision = Literal["auto", "fp32", "bf16"]


def has_fast_bf16(device: torch.device | str) -> bool:
    """Whether bfloat16 matrix products are faster than float32 ones: AMX processors, CUDA from Ampere on."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    if device.type == "cpu":
        return bool(getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)())
    return False


def uses_bf16(device: torch.device | str, precision: Precision = "auto") -> bool:
    """Whether to compute in bfloat16: ``"bf16"`` always, ``"fp32"`` never, ``"auto"`` where it is fast.

    Raises:
        ValueError: an unknown precision.
    """
    if precision not in ("auto", "fp32", "bf16"):
        raise ValueError(f"unknown precision {precision!r}: choose 'auto', 'fp32' or 'bf16'.")
    return precision == "bf16" or (precision == "auto" and has_fast_bf16(device))


def autocast(device: torch.device | str, precision: Precision = "auto") -> torch.autocast:
    """A bfloat16 autocast region on the device where :func:`uses_bf16` says so, else a region that changes nothing."""
    return torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=uses_bf16(device, precision))


def without_autocast(device: torch.device) -> AbstractContextManager:
    """A region in which autocast is off, on devices that know none (meta) too."""
    if not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def in_autocast(device: torch.device) -> bool:
    """Whether autocast is on for a device."""
    return torch.amp.is_autocast_available(device.type) and torch.is_autocast_enabled(device.type)
