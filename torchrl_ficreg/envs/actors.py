"""Objects that live in worker processes and are called by the name of a method.

    caller                                                    worker process w, one thread
      call("step", {0: args, 1: args}) ── pipe ──> object.step(*args)
           <── {0: result, 1: result} ── pipe ──   what it returned, or what it raised

An object keeps its state between calls. What takes the same function to many items is :mod:`.workers`.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import traceback
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import torch

from torchrl_ficreg.envs.process_env import (
    environment_variables,
    ONE_THREAD,
    out_of_handles,
    wait_patiently,
    without_interrupts,
    WorkerTraceback,
)

_JOIN_SECONDS = 5.0
_WARN_SECONDS = 30.0  # without any answer


class Actors:
    """W objects, each in a spawned process with one thread that ends when its parent does, however that comes about.

    Args:
        make: picklable, takes no argument; builds the object, whose ``close`` method is called at the end.
        count: W.
        timeout: seconds after which a call that no worker answers is given up; a warning comes after 30 s.

    Raises:
        RuntimeError: too many open files.
    """

    def __init__(self, make: Callable[[], Any], count: int, *, timeout: float = 1800.0) -> None:
        self._timeout = timeout
        context = multiprocessing.get_context("spawn")  # a forked child would inherit torch's threads half-alive
        self._workers: list[tuple[Connection, BaseProcess]] = []
        self._shut_down = weakref.finalize(self, _shut_down, self._workers)  # also at exit, or if closing is forgotten
        try:
            with environment_variables(ONE_THREAD), without_interrupts():
                for _ in range(count):
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_work, args=(make, theirs), daemon=True)
                    process.start()
                    theirs.close()  # else a dead worker's pipe would look open
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
        """Calls a method of some of the objects side by side and waits for all of them.

        Args:
            method: its name.
            arguments: its arguments, by worker.

        Returns:
            what it returned, by worker.

        Raises:
            Exception: what the method raised in the first worker where it did, with the worker's traceback as its
                cause; the processes live on.
            TimeoutError: no answer in time. All processes have ended then.
            RuntimeError: a worker died, now or before, or the processes were closed. All of them have ended then, as
                after an interruption (Ctrl-C).
        """
        if self.closed:
            raise RuntimeError("the worker processes have ended (closed, or one of them died): start anew.")
        try:
            for worker, values in arguments.items():
                self._send(worker, (method, values))
            answers = self._receive_all(arguments)
        except BaseException:  # what lies in the pipes now would answer the wrong call
            self.close()
            raise
        for answer in answers.values():
            if isinstance(answer, _Failure):
                raise (out_of_handles(answer.error) or answer.error) from WorkerTraceback(answer.traceback)
        return answers

    def close(self) -> None:
        """Ends the processes; a second call does nothing."""
        self._shut_down()

    def _send(self, worker: int, message: Any) -> None:
        try:
            self._workers[worker][0].send(message)
        except (OSError, RuntimeError) as error:  # torch's sharing of tensors raises both
            raise (out_of_handles(error) or self._death(worker)) from error

    def _receive_all(self, workers: Iterable[int]) -> dict[int, Any]:
        """One answer of each, in whatever order they come: a death is seen while others are still busy."""
        answers = dict.fromkeys(workers)
        missing = set(answers)
        while missing:
            # The sentinel too: another process, forked from this one, may hold a dead worker's pipe open.
            signs = {sign: w for w in missing for sign in (self._workers[w][0], self._workers[w][1].sentinel)}
            for worker in {signs[sign] for sign in self._wait(signs)}:
                answers[worker] = self._receive(worker)
                missing.remove(worker)
        return answers

    def _wait(self, signs: dict[Any, int]) -> list[Any]:
        def names() -> str:
            late = sorted(set(signs.values()))
            pids = ", ".join(str(self._workers[worker][1].pid) for worker in late[:4])
            return f"worker process {late[0] + 1} of {len(self._workers)} (pids waited for: {pids})"

        return wait_patiently(signs, names, warn_after=_WARN_SECONDS, timeout=self._timeout)

    def _receive(self, worker: int) -> Any:
        connection = self._workers[worker][0]
        try:
            if connection.poll():
                return pickle.loads(connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise (out_of_handles(error) or self._death(worker)) from error
        raise self._death(worker)

    def _death(self, worker: int) -> RuntimeError:
        process = self._workers[worker][1]
        process.join(_JOIN_SECONDS)
        if process.is_alive():
            return RuntimeError(
                f"worker process {worker + 1} of {len(self._workers)} (pid {process.pid}) lives, but its pipe is broken: "
                "start anew."
            )
        return RuntimeError(
            f"worker process {worker + 1} of {len(self._workers)} died with exit code {process.exitcode}: look for its "
            "last words on stderr (negative: the signal that killed it, -9 often for want of memory; 1 at start: the "
            'script lacks \'if __name__ == "__main__":\').'
        )


def _shut_down(workers: list[tuple[Connection, BaseProcess]]) -> None:
    for connection, _ in workers:
        connection.close()  # a worker that reads or writes its pipe now ends by itself
    for _, process in workers:
        process.join(_JOIN_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()


@dataclass(frozen=True)
class _Failure:
    """An exception on its way from a worker."""

    error: Exception
    traceback: str = ""


def _work(make: Callable[[], Any], connection: Connection) -> None:
    # Ctrl-C reaches the whole process group; the parent alone decides, and closes the pipes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    actor = make()
    with contextlib.suppress(EOFError, OSError):  # the parent has closed the pipe: nothing is left to do
        while True:
            connection.send_bytes(_answer(actor, connection.recv_bytes()))
    actor.close()


def _answer(actor: Any, message: bytes) -> bytes:
    try:
        method, arguments = pickle.loads(message)
        return pickle.dumps(getattr(actor, method)(*arguments))  # by value: torch's own pickling shares memory
    except Exception as error:
        return _pack(error, f"raised in a worker process:\n{traceback.format_exc()}")


def _pack(error: Exception, words: str) -> bytes:
    """The exception itself where it survives the journey, else its words."""
    try:
        packed = pickle.dumps(_Failure(error, words))
        pickle.loads(packed)
    except Exception:
        return pickle.dumps(_Failure(RuntimeError(f"{type(error).__name__}: {error}"), words))
    return packed
