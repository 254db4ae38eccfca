"""What a run costs: speed, waiting for data, memory."""

from __future__ import annotations

import mmap
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torchrl import torchrl_logger

GIB = 2**30


class Meter:
    """Measures between two looks, without a synchronisation of its own.

    Args:
        clips_per_step: of one optimisation step, over all processes.
        waited: seconds waited for data so far, see :class:`~torchrl_ficreg.trainers.stream.ReplayStream`.
        device: whose peak of memory is reported, where it is a CUDA device.

    Examples:
        >>> meter = Meter(clips_per_step=128)
        >>> sorted(meter.look(step=1))
        ['clips_per_second', 'loader_share', 'memory_gib', 'steps_per_second']
    """

    def __init__(
        self, clips_per_step: int, waited: Callable[[], float] = lambda: 0.0, device: torch.device | str = "cpu"
    ) -> None:
        self.clips_per_step, self.waited, self.device = clips_per_step, waited, torch.device(device)
        self._warned = False
        self.begin(0)

    def begin(self, step: int) -> None:
        """Counts from here."""
        self._since = (time.perf_counter(), self.waited(), step)

    def look(self, step: int) -> dict[str, float]:
        """Means since the last look: ``loader_share`` is the part of a step's time in which data was waited for.

        Memory in GiB: ``memory_gib`` resident in this process now, ``cuda_memory_gib`` the most that PyTorch has
        allocated on the device so far.
        """
        began, waited, before = self._since
        self.begin(step)
        seconds = max(self._since[0] - began, 1e-9)
        rate = (step - before) / seconds
        numbers = {
            "steps_per_second": rate,
            "clips_per_second": rate * self.clips_per_step,
            "loader_share": (self._since[1] - waited) / seconds,
        }
        memory = resident_memory()
        if memory is not None:
            numbers["memory_gib"] = memory / GIB
        elif not self._warned:
            torchrl_logger.warning("this system does not tell how much memory a process takes: no memory_gib is noted.")
            self._warned = True
        if self.device.type == "cuda":
            numbers["cuda_memory_gib"] = torch.cuda.max_memory_allocated(self.device) / GIB
        return numbers


def resident_memory() -> int | None:
    """Bytes of this process that lie in memory; else the most there ever were; None where the system tells neither.

    Examples:
        >>> resident_memory() > 1_000_000
        True
    """
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="utf-8").split()[1]) * mmap.PAGESIZE
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
