"""N environments in a few worker processes, seen from outside as one batch.

    caller                    shared memory, [N, ...] per key        worker w
      reset, step ── action ────────> rows of group w ──────────────> its environments, one after the other
           <── copy ── pixels, state, reward, ... <────────────────── written where they belong

TorchRL's ``ParallelEnv`` gives a process to each environment, and a simulator that draws takes 0.2 GB and a graphics
context per process. It could hold a ``SerialEnv`` per process, but groups of unequal size have no common spec there,
what a worker raises stays on that worker's stderr, and the caller waits at full load on a core the workers need.
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
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase

from torchrl_ficreg._utils import (
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


class WorkerGroupsEnv(EnvBase):
    """A batch of N environments in W worker processes, each stepping its group with one thread.

    Bit for bit the ``SerialEnv`` of the same environments: keys, specs, seeds (environment i gets the same one for any
    W), ``reset(list_of_kwargs=[...])``, partial resets by ``_reset`` and partial steps by ``_step``. What an environment
    raises is raised here, and the batch stays usable; it closes when a worker dies or a call is interrupted.

    Args:
        num_envs: N.
        create: picklable; builds one environment without batch dimension and without nested keys.
        num_workers: W; the sizes of the groups differ by at most one.
        timeout: seconds after which a call that no worker answers is given up; a warning comes after 30 s.

    Raises:
        ValueError: W is not in 1..N.
        Exception: what ``create`` raised.
        RuntimeError: a worker process died, too many files are open, or there is too little shared memory.
        TimeoutError: no worker answered in time; the batch is closed then.
        TypeError: it is copied or pickled.
    """

    def __init__(
        self, num_envs: int, create: Callable[[], EnvBase], num_workers: int, *, timeout: float = 1800.0
    ) -> None:
        if not 1 <= num_workers <= num_envs:
            raise ValueError(f"num_workers must be in 1..num_envs ({num_envs}), got {num_workers}.")
        super().__init__(batch_size=[num_envs])
        edges = [num_envs * worker // num_workers for worker in range(num_workers + 1)]
        self._groups = [range(*pair) for pair in zip(edges, edges[1:])]
        self._actors = Actors(_Group, num_workers, timeout=timeout)
        self.is_closed = False
        try:
            specs = self._actors.call("create", {w: (create, len(group)) for w, group in enumerate(self._groups)})
            self._adopt(specs[0])
            shares = {
                worker: ({name: rows[group.start : group.stop] for name, rows in self._rows.items()},)
                for worker, group in enumerate(self._groups)
            }
            self._actors.call("share", shares)
        except BaseException:
            self.close()
            raise

    def _adopt(self, specs: _Specs) -> None:
        """Takes the specs of one environment over for all, and lays out the shared rows."""
        size = self.batch_size
        self.observation_spec = specs.observation.expand(*size, *specs.observation.shape)
        self.full_action_spec = specs.action.expand(*size, *specs.action.shape)
        self.full_reward_spec = specs.reward.expand(*size, *specs.reward.shape)
        self.full_done_spec = specs.done.expand(*size, *specs.done.shape)
        self._action_names = list(specs.action.keys())
        self._reset_names = [*specs.observation.keys(), *specs.done.keys()]
        self._step_names = [*self._reset_names, *specs.reward.keys()]
        parts = (self.observation_spec, self.full_action_spec, self.full_reward_spec, self.full_done_spec)
        zeros = {name: leaf for part in parts for name, leaf in part.zero().items()}
        try:
            self._rows = {name: leaf.contiguous().share_memory_() for name, leaf in zeros.items()}  # each [N, ...]
        except (OSError, RuntimeError) as error:
            needed = sum(leaf.numel() * leaf.element_size() for leaf in zeros.values()) / 2**20
            raise out_of_handles(error) or RuntimeError(
                f"no {needed:.1f} MiB of shared memory for {self.numel()} environments ({str(error)[:80]}): enlarge "
                "/dev/shm (docker run --shm-size=1g), take smaller pictures, or num_workers=None."
            ) from error

    def __reduce_ex__(self, protocol: int) -> str:
        raise TypeError(
            "a batch in worker processes can be neither copied nor pickled: build another one by make_env and reset it "
            "to the states, or leave num_workers at None."
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        per_env = kwargs.pop("list_of_kwargs", None) or [{}] * self.numel()
        if len(per_env) != self.numel():
            raise ValueError(f"list_of_kwargs must have one entry per environment, {self.numel()}, got {len(per_env)}.")
        chosen = self._chosen(tensordict, "_reset")
        self._call("reset", {row: {**per_env[row], **kwargs} for row in chosen})
        return self._read(self._reset_names)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for name in self._action_names:
            self._rows[name].copy_(tensordict[name])
        chosen = self._chosen(tensordict, "_step")
        self._call("step", dict.fromkeys(chosen))
        stepped = self._read(self._step_names)
        if len(chosen) == self.numel():
            return stepped
        # The others keep what the caller holds for them, as with SerialEnv.
        idle = stepped.new_zeros(stepped.shape).update(tensordict.select(*self._step_names, strict=False), clone=True)
        idle[chosen] = stepped[chosen]
        return idle

    def _set_seed(self, seed: int | None) -> None:
        """Never called: :meth:`set_seed` hands the seeds to the environments."""

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds environment 0 with ``seed`` and each next one with the successor; returns the successor of the last."""
        for worker in range(len(self._groups)):
            seed = self._actors.call("set_seed", {worker: (seed, static_seed)})[worker]
        return seed

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Ends the worker processes; a second call does nothing unless it is to be refused.

        Raises:
            RuntimeError: the environment was closed before, and ``raise_if_closed``.
        """
        if self.is_closed and raise_if_closed:
            raise RuntimeError("the environment is closed already.")
        self.is_closed = True
        self._actors.close()

    def _chosen(self, tensordict: TensorDictBase | None, name: str) -> list[int]:
        """The environments that a mask [N] or [N, 1] names; all of them without a mask."""
        mask = None if tensordict is None else tensordict.get(name, None)
        if mask is None:
            return list(range(self.numel()))
        return mask.reshape(self.numel(), -1).any(-1).nonzero().flatten().tolist()

    def _call(self, method: str, rows: dict[int, Any]) -> None:
        """Hands each group its part of ``{environment: argument}``, counted from its first; idle groups get nothing."""
        parts = {
            worker: {row - group.start: rows[row] for row in group if row in rows}
            for worker, group in enumerate(self._groups)
        }
        self._actors.call(method, {worker: (part,) for worker, part in parts.items() if part})

    def _read(self, names: Iterable[str]) -> TensorDict:
        """Copies of the rows, which the next step overwrites."""
        values = TensorDict({name: self._rows[name].clone() for name in names}, self.batch_size)
        return values if self.device is None else values.to(self.device)


@dataclass(frozen=True)
class _Specs:
    """Of one environment."""

    observation: Composite
    action: Composite
    reward: Composite
    done: Composite


class _Group:
    """The environments of one worker; the parent calls these methods by name."""

    def __init__(self) -> None:
        self.envs: list[EnvBase] = []
        self.rows: dict[str, torch.Tensor] = {}  # [group, ...] per key, shared with the parent

    def create(self, create: Callable[[], EnvBase], count: int) -> _Specs:
        self.envs += [create() for _ in range(count)]
        env = self.envs[0]
        return _Specs(env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec)

    def share(self, rows: dict[str, torch.Tensor]) -> None:
        self.rows = rows

    def reset(self, arguments: dict[int, dict[str, Any]]) -> None:
        for row, kwargs in arguments.items():
            self._write(row, self.envs[row].reset(**kwargs))

    def step(self, rows: dict[int, None]) -> None:
        for row in rows:
            env = self.envs[row]
            action = {name: self.rows[name][row].clone() for name in env.full_action_spec.keys()}
            self._write(row, env.step(TensorDict(action))["next"])

    def set_seed(self, seed: int | None, static_seed: bool) -> int | None:
        for env in self.envs:
            seed = env.set_seed(seed, static_seed=static_seed)
        return seed

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _write(self, row: int, values: TensorDictBase) -> None:
        for name, value in values.items():
            self.rows[name][row].copy_(value)
