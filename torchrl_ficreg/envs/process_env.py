"""What starting worker processes and waiting for them takes."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from typing import Any

ONE_THREAD = {  # read when a library is loaded, before any code of a worker process could say so
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",  # Mesa's software GL: helpers beside the thread that draws
}


@contextlib.contextmanager
def environment_variables(variables: dict[str, str]) -> Iterator[None]:
    """Sets some variables, and puts the former ones back at the end.

    Args:
        variables: name -> value.

    Examples:
        >>> with environment_variables({"TORCHRL_FICREG_EXAMPLE": "1"}):
        ...     "TORCHRL_FICREG_EXAMPLE" in os.environ
        True
        >>> "TORCHRL_FICREG_EXAMPLE" in os.environ
        False
    """
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class WorkerTraceback(Exception):
    """Cause of an exception that was raised in a worker process: the traceback there, as text."""


def wait_patiently(
    signs: Collection[Any], workers: Callable[[], str], *, warn_after: float, timeout: float
) -> list[Any]:
    """``multiprocessing.connection.wait`` that warns after a while and gives up in the end.

    Args:
        signs: connections and sentinels, of which one has to become ready.
        workers: names the processes waited for.
        warn_after: seconds until a warning.
        timeout: seconds until the error.

    Returns:
        those that are ready.

    Raises:
        TimeoutError: none became ready in time.
    """
    began = time.monotonic()
    ready = wait(list(signs), min(warn_after, timeout))
    if not ready and warn_after < timeout:
        warnings.warn(
            f"{workers()} has not answered for {warn_after:.0f} s: slow, or stopped? Waiting for up to {timeout:.0f} s.",
            stacklevel=2,
        )
        ready = wait(list(signs), max(0.0, timeout - (time.monotonic() - began)))
    if not ready:
        raise TimeoutError(f"{workers()} has not answered for {timeout:.0f} s: look whether it is stopped or stuck.")
    return ready


def out_of_handles(error: BaseException) -> RuntimeError | None:
    """The error to raise instead of one that stands for too many open files, None for any other."""
    if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE) or "Too many open files" in str(error):
        return RuntimeError(
            "too many open files to run the worker processes: raise the limit (ulimit -n 4096), or use fewer workers."
        )
    return None


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes started meanwhile never receive SIGINT, from their first instant on: Ctrl-C is their parent's to handle.

    A Ctrl-C in the meantime reaches this process at the end.

    Examples:
        >>> with without_interrupts():
        ...     signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        True
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which unblocks SIGINT when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
