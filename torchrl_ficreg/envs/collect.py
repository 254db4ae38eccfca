"""Recording expert episodes, reproducibly and on as many processes as there are.

Everything random about episode i comes from the pair (seed, i). Episodes may therefore be recorded by any process, in
any order and in several sittings: their bytes are the same, and the generator yields them in order.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import numpy as np
import torch

from torchrl_ficreg._utils import (
    environment_variables,
    ONE_THREAD,
    out_of_handles,
    wait_patiently,
    without_interrupts,
    WorkerTraceback,
)
from torchrl_ficreg.envs.base import GOAL_STATE, GoalEnv
from torchrl_ficreg.envs.registry import EnvEntry, Expert, find_entry
from torchrl_ficreg.keys import ACTION, PIXELS, STATE, SUCCESS


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


def collect_episodes(
    name: str,
    num_episodes: int,
    *,
    seed: int = 0,
    start: int = 0,
    num_workers: int = 2,
    image_size: int = 64,
    max_steps: int = 100,
    stop_at_success: bool = True,
    expert_kwargs: dict[str, Any] | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Records the episodes ``start`` to ``num_episodes - 1`` of an environment's expert.

    An episode ends after ``max_steps`` actions, and at success where that is asked for. Row t holds frame t, the state
    it was drawn from and the action that leads to frame t + 1; the last row has no action and holds zeros::

        pixels   o_0  o_1  ...  o_n        n actions, n + 1 rows
        action   a_0  a_1  ...  0

    Args:
        name: an environment of :data:`~torchrl_ficreg.envs.registry.ENVIRONMENTS`, by short name or Gymnasium id.
        num_episodes: size of the whole data set.
        seed: of the whole data set.
        start: number of episodes already there, to resume a recording.
        num_workers: worker processes, each with one torch thread; 0 records in this process. Workers are spawned, so
            a script needs the usual ``if __name__ == "__main__":``.
        image_size: height and width of the pictures, in pixels.
        max_steps: most actions of an episode.
        stop_at_success: end an episode when its goal is reached; else all have ``max_steps`` actions.
        expert_kwargs: passed to the expert, for instance ``{"noise_std": 1.0}``.
        env_kwargs: passed to the environment.

    Returns:
        an iterator over dictionaries of ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S]
        float64. At most two episodes per worker are recorded ahead of the consumer. Closing it stops the workers.

    Raises:
        ValueError: an unknown name, or a number out of range. What an environment or an expert raises while
            recording is raised by the iterator.

    Examples:
        >>> episode = next(collect_episodes("two_room", 1, num_workers=0, max_steps=3))
        >>> {key: (value.shape, str(value.dtype)) for key, value in episode.items()}  # doctest: +NORMALIZE_WHITESPACE
        {'pixels': ((4, 3, 64, 64), 'uint8'),
         'action': ((4, 2), 'float32'),
         'state': ((4, 2), 'float64')}
    """
    if not 0 <= start <= num_episodes:
        raise ValueError(f"start must be between 0 and num_episodes ({num_episodes}), got {start}.")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}.")
    if num_workers < 0:
        raise ValueError(f"num_workers must be at least 0, got {num_workers}.")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}.")
    record = EpisodeRecorder(
        entry=find_entry(name),
        seed=seed,
        max_steps=max_steps,
        stop_at_success=stop_at_success,
        expert_kwargs=dict(expert_kwargs or {}),
        env_kwargs={"image_size": image_size, **(env_kwargs or {})},
    )
    indices = range(start, num_episodes)
    if num_workers == 0:
        return (record(index) for index in indices)  # unlike map(), it can be closed like the other
    return ordered_map(record, indices, num_workers=num_workers)


@dataclass
class EpisodeRecorder:
    """Records the i-th episode of a data set; picklable, and builds its environment where it is first called.

    Attributes:
        entry: where the environment and its expert are found.
        seed: of the whole data set.
        max_steps: most actions of an episode.
        stop_at_success: whether a reached goal ends an episode.
        expert_kwargs: passed to the expert, beside ``rng`` and ``env``.
        env_kwargs: passed to the environment.
    """

    entry: EnvEntry
    seed: int
    max_steps: int
    stop_at_success: bool
    expert_kwargs: dict[str, Any]
    env_kwargs: dict[str, Any]
    _env: GoalEnv | None = field(default=None, init=False, repr=False)

    @property
    def env(self) -> GoalEnv:
        """The environment, built when it is first asked for."""
        if self._env is None:
            self._env = self.entry.load_env()(**self.env_kwargs)
        return self._env

    def begin(self, index: int) -> tuple[GoalEnv, Expert, dict[str, np.ndarray], dict[str, Any]]:
        """Sets an episode up: the environment, a new expert, and the observation and info of the start."""
        task_seed, expert_seed = np.random.SeedSequence(self.seed, spawn_key=(index,)).spawn(2)
        expert = self.entry.load_expert()(rng=np.random.default_rng(expert_seed), env=self.env, **self.expert_kwargs)
        return self.env, expert, *self.env.reset(seed=int(task_seed.generate_state(1)[0]))

    def __call__(self, index: int) -> dict[str, np.ndarray]:
        """Records one episode.

        Args:
            index: of the episode, from 0.

        Returns:
            the arrays described at :func:`collect_episodes`.
        """
        env, expert, observation, info = self.begin(index)
        pixels, states, actions = [observation[PIXELS]], [observation[STATE]], []
        while len(actions) < self.max_steps and not (self.stop_at_success and info[SUCCESS].item()):
            action = expert(observation[STATE], observation[GOAL_STATE])
            observation, _, _, _, info = env.step(action)
            actions.append(action)
            pixels.append(observation[PIXELS])
            states.append(observation[STATE])
        actions.append(np.zeros(env.action_space.shape))
        return {
            PIXELS: np.stack(pixels),
            ACTION: np.stack(actions).astype(np.float32),
            STATE: np.stack(states),
        }
