"""Threads that read frames: shared, started when first needed, and not carried into forked processes."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

MOST_THREADS = 8  # more readers than this only take cores from the training step

_pools: dict[int, ThreadPoolExecutor] = {}

# A forked child has the pools but not their threads, and would wait for them for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_pools.clear)


def default_threads() -> int:
    """The cores this process may use, at most eight.

    Examples:
        >>> 1 <= default_threads() <= 8
        True
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_THREADS)


def run_split(work: Callable[[int, int], None], count: int, *, num_threads: int, smallest: int = 1) -> None:
    """Calls ``work(start, stop)`` until ``range(count)`` is covered, on several threads where that pays.

    Args:
        work: handles the items ``start`` to ``stop - 1``; pieces never overlap. It must not call this function.
        count: number of items.

    Keyword Args:
        num_threads: most threads. With 1, or with too few items, the work is done in the calling thread.
        smallest: items below which a piece is not worth handing over.

    Raises:
        whatever ``work`` raises: of several errors, that of the first piece.

    Examples:
        >>> squares = [0] * 5
        >>> def work(start, stop):
        ...     for item in range(start, stop):
        ...         squares[item] = item**2
        >>> run_split(work, 5, num_threads=2)
        >>> squares
        [0, 1, 4, 9, 16]
    """
    pieces = min(num_threads * 4, count // smallest)  # four per thread, as images differ in the time they take
    if num_threads <= 1 or pieces <= 1:
        return work(0, count)
    if num_threads not in _pools:
        _pools[num_threads] = ThreadPoolExecutor(num_threads, thread_name_prefix="frames")
    bounds = [count * piece // pieces for piece in range(pieces + 1)]
    futures = [_pools[num_threads].submit(work, *piece) for piece in zip(bounds[:-1], bounds[1:])]
    errors = [error for error in [future.exception() for future in futures] if error is not None]
    if errors:
        raise errors[0]
