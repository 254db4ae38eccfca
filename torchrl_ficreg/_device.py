"""Use of a device: numeric precision, and the setting of the memory allocator."""

from __future__ import annotations

import contextlib
import ctypes
import platform
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import get_args, Literal

import torch
import torch.nn.functional as F

Precision = Literal["auto", "fp32", "bf16"]
Kind = Literal["products", "convolutions"]
MIN_SPEEDUP = 1.25  # of bfloat16 over float32 from which "auto" uses it


def has_fast_bf16(device: torch.device | str, kind: Kind = "products") -> bool:
    """Whether bfloat16 is faster than float32: on CUDA devices from Ampere on; on CPUs :func:`bf16_speedup` decides.

    Args:
        device (torch.device or str): the device.
        kind (str, optional): ``"products"`` (matrix products) or ``"convolutions"``. A CPU can be fast at one and slow at
            the other. Default: ``"products"``.

    Examples:
        >>> has_fast_bf16("mps")
        False
    """
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    return device.type == "cpu" and bf16_speedup(kind) >= MIN_SPEEDUP


_measuring = threading.Lock()  # two measurements at once would disturb each other's times and number of threads
_speedups: dict[tuple[Kind, bool], float] = {}


@torch.compiler.assume_constant_result
def bf16_speedup(kind: Kind = "products") -> float:
    """Speed of a layer's training step in bfloat16 relative to float32 on this CPU, measured once per process.

    The first call takes some tens of milliseconds. The feature flags of the processor are not sufficient: oneDNN computes
    bfloat16 on any processor with AVX-512, at a third of the speed of float32 where the instructions are missing or
    disabled (``ONEDNN_MAX_CPU_ISA``). Typical values: 10 with AMX, 2 with AVX512_BF16, below 0.5 elsewhere.

    Args:
        kind (str, optional): ``"products"`` or ``"convolutions"``. Default: ``"products"``.

    Raises:
        KeyError: an unknown kind.
    """
    # The modes of torch are local to a thread: in a new one no tensor is fake, traced, mapped or recorded.
    case = kind, torch.backends.mkldnn.enabled  # torch.export disables oneDNN while it traces
    with _measuring:
        if case not in _speedups:
            with ThreadPoolExecutor(1) as thread:
                _speedups[case] = thread.submit(_measure, kind).result()
        return _speedups[case]


def _measure(kind: Kind) -> float:
    make = {"products": _product, "convolutions": _convolution}[kind]
    least, threads = {}, torch.get_num_threads()
    torch.set_num_threads(1)  # on a busy machine, several threads wait for each other
    try:
        layers = {dtype: make(dtype) for dtype in (torch.float32, torch.bfloat16)}
        for turn in range(5):  # the first one prepares the kernels
            for dtype, layer in layers.items():
                began = time.thread_time()
                layer()
                if turn:
                    least[dtype] = min(least.get(dtype, float("inf")), time.thread_time() - began)
            if turn and least[torch.bfloat16] > 1.5 * least[torch.float32]:
                break  # clearly slower: no further turn is needed
    finally:
        torch.set_num_threads(threads)
    return least[torch.float32] / least[torch.bfloat16]


# Without autograd, which does not work in a process forked from one that trains on a GPU.
def _product(dtype: torch.dtype) -> Callable[[], object]:
    """A linear layer of 512 rows, as wide as the paper's networks, forward and backward."""
    x, weight = torch.ones(512, 192, dtype=dtype, device="cpu"), torch.ones(768, 192, dtype=dtype, device="cpu")
    above = torch.ones(512, 768, dtype=dtype, device="cpu")
    return lambda: (F.linear(x, weight), above @ weight, above.t() @ x)


def _convolution(dtype: torch.dtype) -> Callable[[], object]:
    """A 3 x 3 convolution of the keypoint encoder on 64 frames, forward and backward."""
    shapes = (64, 32, 16, 16), (32, 32, 3, 3), (64, 32, 16, 16)
    x, weight, above = (
        torch.ones(shape, dtype=dtype, device="cpu").contiguous(memory_format=torch.channels_last) for shape in shapes
    )
    setting = [1, 1], [1, 1], [1, 1], False, [0, 0], 1  # stride, padding, dilation, transposed, output padding, groups
    backward = torch.ops.aten.convolution_backward
    return lambda: (
        F.conv2d(x, weight, padding=1), backward(above, x, weight, None, *setting, [True, True, False])
    )


def uses_bf16(device: torch.device | str, precision: Precision = "auto") -> bool:
    """Whether to compute in bfloat16: ``"bf16"`` always, ``"fp32"`` never, ``"auto"`` if :func:`has_fast_bf16`.

    Args:
        device (torch.device or str): the device.
        precision (str, optional): ``"auto"``, ``"bf16"`` or ``"fp32"``. Default: ``"auto"``.

    Raises:
        ValueError: an unknown precision.
    """
    check_precision(precision)
    return precision == "bf16" or (precision == "auto" and has_fast_bf16(device))


def check_precision(precision: str) -> None:
    """Checks the name of a precision.

    Raises:
        ValueError: it is not ``"auto"``, ``"fp32"`` or ``"bf16"``.
    """
    if precision not in ("auto", "fp32", "bf16"):
        raise ValueError(f"unknown precision {precision!r}: choose 'auto', 'fp32' or 'bf16'.")


def autocast(device: torch.device | str, precision: Precision = "auto") -> torch.autocast:
    """Context: bfloat16 autocast if :func:`uses_bf16`; without effect otherwise.

    Convolutions of the package's encoders stay in float32 on a CPU that is slow at them in bfloat16, with ``"bf16"`` too.

    Args:
        device (torch.device or str): the device.
        precision (str, optional): ``"auto"``, ``"bf16"`` or ``"fp32"``. Default: ``"auto"``.
    """
    return torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=uses_bf16(device, precision))


def convolution_region(device: torch.device) -> contextlib.AbstractContextManager:
    """Context inside :func:`autocast`: disables bfloat16 on a CPU that is slow at convolutions in it."""
    slow = device.type == "cpu" and in_autocast(device) and torch.get_autocast_dtype("cpu") == torch.bfloat16
    if slow and not has_fast_bf16(device, "convolutions"):
        return without_autocast(device)
    return contextlib.nullcontext()


def describe_precision(device: torch.device | str, precision: Precision = "auto") -> str:
    """One line for a log: the device, the precision in use, and on CPUs the measurements that it is based on.

    Examples:
        >>> describe_precision("cuda:1", "fp32")
        'cuda:1, fp32'
    """
    chosen = f"{device}, {'bf16' if uses_bf16(device, precision) else 'fp32'}"
    return f"{chosen} ({describe_processor()})" if torch.device(device).type == "cpu" else chosen


def describe_processor() -> str:
    """Name of the CPU, the vector instructions that torch uses, and its :func:`bf16_speedup`."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    figures = (f"{bf16_speedup(kind):.1f} x in {kind}" for kind in get_args(Kind))
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{name}, {capability}, bf16 is {', '.join(figures)}"


def without_autocast(device: torch.device) -> contextlib.AbstractContextManager:
    """Context without autocast; accepts devices that do not support autocast (meta)."""
    if not torch.amp.is_autocast_available(device.type):
        return contextlib.nullcontext()
    return torch.autocast(device.type, enabled=False)


def in_autocast(device: torch.device) -> bool:
    """Whether autocast is enabled for a device."""
    return torch.amp.is_autocast_available(device.type) and torch.is_autocast_enabled(device.type)


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # parameters of glibc's mallopt
DEFAULT_KEPT_BYTES = 256 * 2**20
_largest_kept = 0  # bytes, of all calls so far


def keep_freed_memory(kept: int = DEFAULT_KEPT_BYTES, *, allow_decrease: bool = False) -> bool:
    """Makes glibc keep freed memory for the next tensor, instead of returning its pages to the kernel.

    On CPUs, networks allocate and free tensors of some megabytes thousands of times a second. By default each one gets
    fresh pages, which the kernel zeroes one page fault at a time: a fifth of the time of a plan. The price is up to
    ``kept`` bytes that stay with the process. The setting is global to the process; other systems and allocators are left
    alone.

    Args:
        kept (int, optional): size in bytes up to which blocks are reused, and up to which free memory at the top of the
            heap is kept. Default: 256 MiB.
        allow_decrease (bool, optional): whether a smaller value replaces a larger one of an earlier call. By default the
            largest counts, so that a plan during training does not undo the setting of the training.
            Default: ``False``.

    Returns:
        whether the allocator accepted the setting.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    global _largest_kept
    _largest_kept = kept = kept if allow_decrease else max(kept, _largest_kept)
    return bool(mallopt(_MMAP_THRESHOLD, kept)) and bool(mallopt(_TRIM_THRESHOLD, kept))
