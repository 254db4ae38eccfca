"""N environments in a few worker processes, as one batch.

    caller                    shared memory, [N, ...] per key        worker w
      reset, step ── action ────────> rows of group w ──────────────> its environments, one after the other
           <── copy ── pixels, state, reward, ... <────────────────── written in place

TorchRL's ``ParallelEnv`` runs one process per environment, and an environment with a renderer takes 0.2 GB and a
graphics context per process. It could hold a ``SerialEnv`` per process, but groups of unequal size have no common spec
there, exceptions of a worker remain on its stderr, and the caller waits at full load on a core that the workers need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase

from torchrl_ficreg._utils import out_of_handles
from torchrl_ficreg.envs._workers import WorkerPool


class WorkerGroupsEnv(EnvBase):
    """A batch of N environments in W worker processes, each of which steps its group with one thread.

    Bit for bit the ``SerialEnv`` of the same environments: keys, specs, seeds (that of environment i does not depend on
    W), ``reset(list_of_kwargs=[...])``, partial resets by ``_reset`` and partial steps by ``_step``. An exception of an
    environment is raised here, and the batch stays usable; it is closed when a worker dies or a call is interrupted.

    Args:
        num_envs (int): N.
        create (Callable): picklable; builds one environment without batch dimension and without nested keys.
        num_workers (int): W; the sizes of the groups differ by at most one.
        timeout (float, optional): seconds without any answer until a call is given up; a warning comes after 30 s.
            Default: ``1800.0``.

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
        self._pool = WorkerPool(_Group, num_workers, timeout=timeout)
        self.is_closed = False
        try:
            specs = self._pool.call("create", {w: (create, len(group)) for w, group in enumerate(self._groups)})
            self._adopt(specs[0])
            parts = {
                worker: ({name: rows[group.start : group.stop] for name, rows in self._rows.items()},)
                for worker, group in enumerate(self._groups)
            }
            self._pool.call("share", parts)
        except BaseException:
            self.close()
            raise

    def _adopt(self, specs: _Specs) -> None:
        """Sets the specs of the batch from those of one environment and allocates the shared rows."""
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
        # The others keep the values of the caller's tensordict, as with SerialEnv.
        idle = stepped.new_zeros(stepped.shape).update(tensordict.select(*self._step_names, strict=False), clone=True)
        idle[chosen] = stepped[chosen]
        return idle

    def _set_seed(self, seed: int | None) -> None:
        """Never called: :meth:`set_seed` passes the seeds to the environments."""

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds environment 0 with ``seed`` and each next one with the seed that the previous one returned.

        Args:
            seed (int, optional): of environment 0. Default: ``None``.
            static_seed (bool, optional): use the same seed for all. Default: ``False``.

        Returns:
            the seed after the last one.
        """
        for worker in range(len(self._groups)):
            seed = self._pool.call("set_seed", {worker: (seed, static_seed)})[worker]
        return seed

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Ends the worker processes; a second call does nothing.

        Args:
            raise_if_closed (bool, optional): refuse a second call. Default: ``False``.

        Raises:
            RuntimeError: the environment was closed before, and ``raise_if_closed``.
        """
        if self.is_closed and raise_if_closed:
            raise RuntimeError("the environment is closed already.")
        self.is_closed = True
        self._pool.close()

    def _chosen(self, tensordict: TensorDictBase | None, name: str) -> list[int]:
        """Indices of the environments in a mask [N] or [N, 1]; all of them without a mask."""
        mask = None if tensordict is None else tensordict.get(name, None)
        if mask is None:
            return list(range(self.numel()))
        return mask.reshape(self.numel(), -1).any(-1).nonzero().flatten().tolist()

    def _call(self, method: str, rows: dict[int, Any]) -> None:
        """Calls a method of each group with its part of ``{environment: argument}``, keyed by index in the group."""
        parts = {
            worker: {row - group.start: rows[row] for row in group if row in rows}
            for worker, group in enumerate(self._groups)
        }
        self._pool.call(method, {worker: (part,) for worker, part in parts.items() if part})

    def _read(self, names: Iterable[str]) -> TensorDict:
        """Copies of the shared rows, which the next step overwrites."""
        values = TensorDict({name: self._rows[name].clone() for name in names}, self.batch_size)
        return values if self.device is None else values.to(self.device)


@dataclass(frozen=True)
class _Specs:
    """The specs of one environment."""

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
