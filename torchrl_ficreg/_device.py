"""How a device is used: numeric precision, and memory that is kept between steps."""

from __future__ import annotations

import contextlib
import ctypes
import platform
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import get_args, Literal

import torch
import torch.nn.functional as F


Precision = Literal["auto", "fp32", "bf16"]
Kind = Literal["products", "convolutions"]
FAST = 1.25  # times float32 from which bfloat16 is worth its rounding


def has_fast_bf16(device: torch.device | str, kind: Kind = "products") -> bool:
    """Whether bfloat16 is faster than float32: on CUDA from Ampere on, on CPUs where :func:`bf16_speedup` says so.

    Args:
        device: a device, or its name.
        kind: matrix products or convolutions. A CPU can be fast at one and slow at the other.
    """
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    return device.type == "cpu" and bf16_speedup(kind) >= FAST


_measuring = threading.Lock()  # two at once would disturb each other, and lose the number of threads they restore
_speedups: dict[tuple[Kind, bool], float] = {}


@torch.compiler.assume_constant_result
def bf16_speedup(kind: Kind = "products") -> float:
    """How many times faster than float32 this CPU trains a layer in bfloat16, measured once per process.

    Takes some tens of milliseconds at the first call. What a processor says of itself does not tell: oneDNN computes
    bfloat16 on any processor with AVX-512, at a third of the speed of float32 where the instructions are missing or
    switched off (``ONEDNN_MAX_CPU_ISA``). Typical figures: 10 with AMX, 2 with AVX512_BF16, below 0.5 elsewhere.

    Raises:
        KeyError: an unknown kind.
    """
    # The modes of torch belong to a thread: in a new one no tensor is fake, traced, mapped or recorded.
    case = kind, torch.backends.mkldnn.enabled  # torch.export switches oneDNN off while it traces
    with _measuring:
        if case not in _speedups:
            with ThreadPoolExecutor(1) as thread:
                _speedups[case] = thread.submit(_measure, kind).result()
        return _speedups[case]


def _measure(kind: Kind) -> float:
    make = {"products": _product, "convolutions": _convolution}[kind]
    least, threads = {}, torch.get_num_threads()
    torch.set_num_threads(1)  # threads wait for each other on a busy machine; the time of one is its own
    try:
        layers = {dtype: make(dtype) for dtype in (torch.float32, torch.bfloat16)}
        for turn in range(5):  # kernels are prepared in the first
            for dtype, layer in layers.items():
                began = time.thread_time()
                layer()
                if turn:
                    least[dtype] = min(least.get(dtype, float("inf")), time.thread_time() - began)
            if turn and least[torch.bfloat16] > 1.5 * least[torch.float32]:
                break  # no further turn will make up for that
    finally:
        torch.set_num_threads(threads)
    return least[torch.float32] / least[torch.bfloat16]


# Gradients without autograd, which a process forked from one that trains on a GPU cannot use.
def _product(dtype: torch.dtype) -> Callable[[], object]:
    """A linear layer of 512 rows, as wide as the paper's networks, forward and backward."""
    x, weight = torch.ones(512, 192, dtype=dtype, device="cpu"), torch.ones(768, 192, dtype=dtype, device="cpu")
    above = torch.ones(512, 768, dtype=dtype, device="cpu")
    return lambda: (F.linear(x, weight), above @ weight, above.t() @ x)


def _convolution(dtype: torch.dtype) -> Callable[[], object]:
    """The second convolution of the keypoint encoder on 16 frames, forward and backward."""
    shapes = (16, 32, 32, 32), (64, 32, 4, 4), (16, 64, 16, 16)
    x, weight, above = (
        torch.ones(shape, dtype=dtype, device="cpu").contiguous(memory_format=torch.channels_last) for shape in shapes
    )
    setting = [2, 2], [1, 1], [1, 1], False, [0, 0], 1  # stride, padding, dilation, transposed, output padding, groups
    backward = torch.ops.aten.convolution_backward
    return lambda: (
        F.conv2d(x, weight, stride=2, padding=1), backward(above, x, weight, None, *setting, [True, True, False])
    )


@cache
def has_amx() -> bool:
    """Whether the CPU multiplies bfloat16 in tiles (Intel's AMX), ten times as fast as float32."""
    known = getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)()
    return bool(known) and has_fast_bf16("cpu")


def uses_bf16(device: torch.device | str, precision: Precision = "auto") -> bool:
    """Whether to compute in bfloat16: ``"bf16"`` always, ``"fp32"`` never, ``"auto"`` where products in it are fast.

    Raises:
        ValueError: an unknown precision.
    """
    check_precision(precision)
    return precision == "bf16" or (precision == "auto" and has_fast_bf16(device))


def check_precision(precision: str) -> None:
    """Refuses an unknown precision.

    Raises:
        ValueError: other than ``"auto"``, ``"fp32"`` and ``"bf16"``.
    """
    if precision not in ("auto", "fp32", "bf16"):
        raise ValueError(f"unknown precision {precision!r}: choose 'auto', 'fp32' or 'bf16'.")


def autocast(device: torch.device | str, precision: Precision = "auto") -> torch.autocast:
    """A bfloat16 autocast region on the device where :func:`uses_bf16` says so, else a region that changes nothing.

    Convolutions of the package's encoders stay in float32 on a CPU that is slow at them in bfloat16, under ``"bf16"`` too.
    """
    return torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=uses_bf16(device, precision))


def convolution_region(device: torch.device) -> contextlib.AbstractContextManager:
    """Within a region of :func:`autocast`: bfloat16 goes off on a CPU that is slow at convolutions in it."""
    slow = device.type == "cpu" and in_autocast(device) and torch.get_autocast_dtype("cpu") == torch.bfloat16
    if slow and not has_fast_bf16(device, "convolutions"):
        return without_autocast(device)
    return contextlib.nullcontext()


def describe_precision(device: torch.device | str, precision: Precision = "auto") -> str:
    """One line for a log: the device, the precision in use, and on CPUs what it was chosen by.

    Examples:
        >>> describe_precision("cuda:1", "fp32")
        'cuda:1, fp32'
    """
    chosen = f"{device}, {'bf16' if uses_bf16(device, precision) else 'fp32'}"
    return f"{chosen} ({describe_processor()})" if torch.device(device).type == "cpu" else chosen


def describe_processor() -> str:
    """The CPU's name, the vector instructions that torch uses, and what bfloat16 is worth on it."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    figures = (f"{bf16_speedup(kind):.1f} x in {kind}" for kind in get_args(Kind))
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{name}, {capability}, bf16 is {', '.join(figures)}"


def without_autocast(device: torch.device) -> contextlib.AbstractContextManager:
    """A region in which autocast is off, on devices that know none (meta) too."""
    if not torch.amp.is_autocast_available(device.type):
        return contextlib.nullcontext()
    return torch.autocast(device.type, enabled=False)


def in_autocast(device: torch.device) -> bool:
    """Whether autocast is on for a device."""
    return torch.amp.is_autocast_available(device.type) and torch.is_autocast_enabled(device.type)


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of glibc's mallopt
KEPT = 256 * 2**20  # bytes
_most = 0  # bytes that were asked for so far


def keep_freed_memory(kept: int = KEPT, *, lower: bool = False) -> bool:
    """Asks glibc to keep freed memory for the next tensor instead of handing its pages back to the kernel.

    On CPUs, networks make and free tensors of some megabytes thousands of times a second. By default each gets fresh
    pages that the kernel zeroes one fault at a time: a fifth of the time of a plan. The price is up to ``kept`` bytes
    that stay with the process. A setting of the whole process; other systems and allocators are left alone.

    Args:
        kept: size up to which blocks are reused, and free memory at the top of the heap is kept, in bytes.
        lower: also if more was asked for before. By default the most counts: a plan in the middle of training must not
            take away what training keeps.

    Returns:
        whether the allocator has such a setting.

    Examples:
        >>> keep_freed_memory() in (True, False)
        True
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    global _most
    _most = kept = kept if lower else max(kept, _most)
    return bool(mallopt(_MMAP_THRESHOLD, kept)) and bool(mallopt(_TRIM_THRESHOLD, kept))
