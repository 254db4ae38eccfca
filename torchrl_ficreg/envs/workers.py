"""A parallel ``map`` that keeps the order, bounds what lies ready, and leaves no process behind.

    caller              ordered_map                       worker processes
      next() <── in order ── results ready <── pipe ── result <── function(item)
                              └─ next item ──── pipe ──> at most two items each

A worker holds at most one item under work and one waiting, and its pipe blocks until a result is read. A worker whose
pipe is gone ends by itself, so even a killed parent leaves none behind.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import torch

from torchrl_ficreg.envs.process_env import (
    environment_variables,
    ONE_THREAD,
    out_of_handles,
    wait_patiently,
    without_interrupts,
    WorkerTraceback,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

_ITEMS_PER_WORKER = 2  # one under work and one waiting, so that a worker never idles for want of an item
_JOIN_SECONDS = 5.0
_WARN_SECONDS = 300.0  # without any result; an episode of pictures takes a while


def ordered_map(
    function: Callable[[Item], Result], items: Iterable[Item], *, num_workers: int, timeout: float = 7200.0
) -> Iterator[Result]:
    """Maps a function over items in worker processes and yields the results in the order of the items.

    Args:
        function: picklable; copied to and called in spawned processes with one torch thread each.
        items: picklable and small (a result may wait in the pipe while one is sent); drawn as results are consumed,
            never more than ``2 * num_workers`` ahead.
        num_workers: number of processes, at least 1.
        timeout: seconds without any result after which it gives up; a warning comes after 300 s.

    Yields:
        ``function(item)`` for each item.

    Raises:
        Exception: what the function raised, with the worker's traceback as its cause.
        RuntimeError: a worker process died, or too many files are open.
        TimeoutError: no result in time.
    """
    context = multiprocessing.get_context("spawn")  # a forked child would inherit torch's threads half-alive
    workers: dict[Connection, BaseProcess] = {}
    try:
        with environment_variables(ONE_THREAD), without_interrupts():
            for _ in range(num_workers):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(function, theirs), daemon=True)
                process.start()
                theirs.close()  # else a dead worker's pipe would look open
                workers[ours] = process
        yield from _exchange(workers, enumerate(items), timeout)
    except OSError as error:
        if (reason := out_of_handles(error)) is not None:
            raise reason from error
        raise
    finally:
        _shut_down(workers)


def _exchange(
    workers: dict[Connection, BaseProcess], tasks: Iterator[tuple[int, Any]], timeout: float
) -> Iterator[Any]:
    load = dict.fromkeys(workers, 0)
    owner: dict[int, Connection] = {}
    ready: dict[int, Any] = {}
    position = 0  # of the next result to be yielded
    window = _ITEMS_PER_WORKER * len(workers)
    exhausted = False
    while True:
        while not exhausted and len(owner) + len(ready) < window:
            connection = min(load, key=load.__getitem__)
            if load[connection] == _ITEMS_PER_WORKER:
                break
            task = next(tasks, None)
            if task is None:
                exhausted = True
                break
            _send(connection, task, workers)
            owner[task[0]] = connection
            load[connection] += 1
        if position in ready:
            result = ready.pop(position)
            if isinstance(result, _Failure):
                raise result.error from WorkerTraceback(result.traceback)  # only now: what comes before it has been delivered
            yield result
            position += 1
            continue
        if not owner:
            return
        busy = set(owner.values())
        pids = ", ".join(str(workers[connection].pid) for connection in busy)
        for connection in wait_patiently(
            busy, lambda: f"the group of worker processes {pids}", warn_after=_WARN_SECONDS, timeout=timeout
        ):
            index, result = _receive(connection, workers)
            del owner[index]
            load[connection] -= 1
            ready[index] = result


def _send(connection: Connection, task: tuple[int, Any], workers: dict[Connection, BaseProcess]) -> None:
    try:
        connection.send(task)
    except OSError as error:
        raise _death(workers[connection]) from error


def _receive(connection: Connection, workers: dict[Connection, BaseProcess]) -> tuple[int, Any]:
    try:
        return connection.recv()
    except (EOFError, OSError) as error:
        raise _death(workers[connection]) from error


def _death(process: BaseProcess) -> RuntimeError:
    process.join(_JOIN_SECONDS)
    return RuntimeError(
        f"a worker process died with exit code {process.exitcode}: look for its last words on stderr (negative: the "
        'signal that killed it; 1 at start: the script lacks \'if __name__ == "__main__":\').'
    )


def _shut_down(workers: dict[Connection, BaseProcess]) -> None:
    for connection in workers:
        connection.close()  # a worker that reads or writes its pipe now ends by itself
    for process in workers.values():
        process.join(_JOIN_SECONDS)
        if process.is_alive():
            process.terminate()
            process.join()


class _Failure:
    """An exception on its way from a worker."""

    def __init__(self, error: Exception, traceback: str = "") -> None:
        self.error, self.traceback = error, traceback


def _work(function: Callable[[Any], Any], connection: Connection) -> None:
    # Ctrl-C reaches the whole process group; the parent alone decides, and closes the pipes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    with contextlib.suppress(EOFError, OSError):  # the parent has closed the pipe: nothing is left to do
        while True:
            index, item = connection.recv()
            result = _call(function, item)
            try:
                connection.send((index, result))
            except OSError:
                raise
            except Exception as error:  # not picklable, be it a result or an exception
                words = result.error if isinstance(result, _Failure) else error
                connection.send((index, _Failure(RuntimeError(f"{type(words).__name__}: {words}"), getattr(result, "traceback", ""))))


def _call(function: Callable[[Any], Any], item: Any) -> Any:
    try:
        return function(item)
    except Exception as error:
        return _Failure(error, f"raised in a worker process at item {item!r}:\n{traceback.format_exc()}")
