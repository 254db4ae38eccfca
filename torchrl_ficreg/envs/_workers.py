"""A pool of worker processes, for batched environments and for recording.

Workers are spawned with one thread each, exit when their parent does, however it ends, and leave Ctrl-C to it. A worker
that raises, dies or stops answering is an exception in the parent, and no process remains.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import pickle
import signal
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import torch

from torchrl_ficreg._utils import (
    environment_variables,
    ONE_THREAD,
    out_of_handles,
    wait_patiently,
    without_interrupts,
    WorkerTraceback,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

_JOIN_SECONDS = 5.0
_ITEMS_PER_WORKER = 2  # one in work and one in the pipe, so that a worker does not wait for the parent


class WorkerPool:
    """W objects, each in a spawned process with one thread.

    Args:
        make (Callable): picklable, without arguments; builds the object of a worker, whose ``close`` method, if it has
            one, is called at the end.
        num_workers (int): W.
        warn_after (float, optional): seconds without any answer until a warning. Default: ``30.0``.
        timeout (float, optional): seconds without any answer until the pool is closed. Default: ``1800.0``.

    Raises:
        RuntimeError: too many open files.
    """

    def __init__(
        self, make: Callable[[], Any], num_workers: int, *, warn_after: float = 30.0, timeout: float = 1800.0
    ) -> None:
        self._warn_after, self._timeout = warn_after, timeout
        context = multiprocessing.get_context("spawn")  # a forked child inherits the locks of torch's threads
        self._workers: list[tuple[Connection, BaseProcess]] = []
        self._shut_down = weakref.finalize(self, _shut_down, self._workers)  # also at exit, and without a close()
        try:
            with environment_variables(ONE_THREAD), without_interrupts():
                for _ in range(num_workers):
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_run, args=(make, theirs), daemon=True)
                    process.start()
                    theirs.close()  # else the pipe of a dead worker stays open
                    self._workers.append((ours, process))
        except BaseException as error:
            self.close()
            if (reason := out_of_handles(error)) is not None:
                raise reason from error
            raise

    def __reduce__(self) -> str:
        raise TypeError("worker processes can be neither copied nor pickled: start new ones.")

    @property
    def closed(self) -> bool:
        """Whether the processes have ended."""
        return not self._shut_down.alive

    @property
    def pids(self) -> list[int]:
        """Process ids, by worker."""
        return [process.pid for _, process in self._workers]

    def call(self, method: str, arguments: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Calls a method of some of the objects in parallel and waits for all of them.

        Args:
            method (str): name of the method.
            arguments (dict): positional arguments, by worker.

        Returns:
            the results, by worker.

        Raises:
            Exception: what the method raised in the first worker where it did, with the worker's traceback as its
                cause; the processes continue.
            TimeoutError: no answer in time. All processes have ended then.
            RuntimeError: a worker died, now or before, or the pool is closed. All processes have ended then, as after
                an interruption (Ctrl-C).
        """
        if self.closed:
            raise RuntimeError("the worker processes have ended (closed, or one of them died): start new ones.")
        answers = dict.fromkeys(arguments)
        missing = set(answers)
        try:
            for worker, values in arguments.items():
                self.send(worker, method, *values)
            while missing:
                for worker in self.wait(missing):
                    answers[worker] = self.receive(worker)
                    missing.remove(worker)
        except BaseException:  # answers left in the pipes would be taken for those of the next call
            self.close()
            raise
        for answer in answers.values():
            if isinstance(answer, Failure):
                answer.raise_here()
        return answers

    def send(self, worker: int, method: str, *arguments: Any) -> None:
        """Sends a call to a worker; :meth:`receive` returns its answers in the order of the calls."""
        try:
            self._workers[worker][0].send((method, arguments))
        except (OSError, RuntimeError) as error:  # torch's sharing of tensors raises both
            raise (out_of_handles(error) or self._death(worker)) from error

    def wait(self, workers: Iterable[int]) -> set[int]:
        """Waits until some of these workers have answered or died, and returns them."""
        # Sentinels too: another process, forked from this one, may hold the pipe of a dead worker open.
        signs = {sign: worker for worker in workers for sign in (self._workers[worker][0], self._workers[worker][1].sentinel)}

        def names() -> str:
            late = sorted(set(signs.values()))
            pids = ", ".join(str(self._workers[worker][1].pid) for worker in late[:4])
            return f"worker process {late[0] + 1} of {len(self._workers)} (pids waited for: {pids})"

        ready = wait_patiently(signs, names, warn_after=self._warn_after, timeout=self._timeout)
        return {signs[sign] for sign in ready}

    def receive(self, worker: int) -> Any:
        """Returns the next answer of a worker: a result, or the :class:`Failure` of a call that raised."""
        connection = self._workers[worker][0]
        try:
            if connection.poll():
                return pickle.loads(connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise (out_of_handles(error) or self._death(worker)) from error
        raise self._death(worker)

    def close(self) -> None:
        """Ends the processes; a second call does nothing."""
        self._shut_down()

    def _death(self, worker: int) -> RuntimeError:
        process = self._workers[worker][1]
        process.join(_JOIN_SECONDS)
        name = f"worker process {worker + 1} of {len(self._workers)}"
        if process.is_alive():
            return RuntimeError(f"{name} (pid {process.pid}) lives, but its pipe is broken: start new processes.")
        return RuntimeError(
            f"{name} died with exit code {process.exitcode}: read its messages on stderr (a negative code is the signal "
            "that killed it, -9 often for lack of memory; 1 at start: the script lacks 'if __name__ == \"__main__\":')."
        )


@dataclass(frozen=True)
class Failure:
    """The answer of a call that raised.

    Attributes:
        error: the exception, or a RuntimeError with its message where it cannot be pickled.
        traceback: the worker's traceback.
    """

    error: Exception
    traceback: str

    def raise_here(self, context: str = "") -> None:
        """Raises the exception, with ``context`` and the worker's traceback as its cause."""
        words = f"raised in a worker process{context}:\n{self.traceback}"
        raise (out_of_handles(self.error) or self.error) from WorkerTraceback(words)


def ordered_map(
    function: Callable[[Item], Result], items: Iterable[Item], *, num_workers: int, timeout: float = 7200.0
) -> Iterator[Result]:
    """Maps a function over items in worker processes and yields the results in the order of the items.

    Args:
        function (Callable): picklable; copied to each worker.
        items (Iterable): picklable and small (a worker may still be sending a result while its next item is sent);
            drawn as results are consumed, at most ``2 * num_workers`` ahead.
        num_workers (int): number of processes, at least 1.
        timeout (float, optional): seconds without any result after which it gives up; a warning comes after 300 s.
            Default: ``7200.0``.

    Yields:
        ``function(item)`` for each item.

    Raises:
        Exception: what the function raised, after the results before it, with the worker's traceback as its cause.
        RuntimeError: a worker process died, or too many files are open.
        TimeoutError: no result in time.
    """
    make = functools.partial(_itself, function)
    with contextlib.closing(WorkerPool(make, num_workers, warn_after=300.0, timeout=timeout)) as pool:
        tasks = enumerate(items)
        sent: list[list[tuple[int, Item]]] = [[] for _ in range(num_workers)]  # tasks without an answer, by worker
        done: dict[int, tuple[Item, Result | Failure]] = {}
        position = 0  # of the next result to be yielded
        exhausted = False
        while True:
            while not exhausted and sum(map(len, sent)) + len(done) < _ITEMS_PER_WORKER * num_workers:
                worker = min(range(num_workers), key=lambda index: len(sent[index]))
                if len(sent[worker]) == _ITEMS_PER_WORKER:
                    break
                if (task := next(tasks, None)) is None:
                    exhausted = True
                    break
                pool.send(worker, "__call__", task[1])
                sent[worker].append(task)
            if position in done:
                item, result = done.pop(position)
                if isinstance(result, Failure):
                    result.raise_here(f" at item {item!r}")
                yield result
                position += 1
            elif any(sent):
                for worker in pool.wait([index for index, waiting in enumerate(sent) if waiting]):
                    answer = pool.receive(worker)
                    index, item = sent[worker].pop(0)
                    done[index] = item, answer
            else:
                return


def _itself(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    return function


def _shut_down(workers: list[tuple[Connection, BaseProcess]]) -> None:
    for connection, _ in workers:
        connection.close()  # a worker that reads or writes its pipe now exits
    for _, process in workers:
        process.join(_JOIN_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()


def _run(make: Callable[[], Any], connection: Connection) -> None:
    """What a worker process executes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the process group; the parent closes the pipes
    torch.set_num_threads(1)
    worker = make()
    with contextlib.suppress(EOFError, OSError):  # the parent has closed the pipe
        while True:
            connection.send_bytes(_answer(worker, connection.recv_bytes()))
    if hasattr(worker, "close"):
        worker.close()


def _answer(worker: Any, message: bytes) -> bytes:
    try:
        method, arguments = pickle.loads(message)
        return pickle.dumps(getattr(worker, method)(*arguments))  # by value: torch's own pickling shares memory
    except Exception as error:
        text = traceback.format_exc()
        try:
            packed = pickle.dumps(Failure(error, text))
            pickle.loads(packed)  # some exceptions pickle and cannot be unpickled
        except Exception:
            return pickle.dumps(Failure(RuntimeError(f"{type(error).__name__}: {error}"), text))
        return packed
