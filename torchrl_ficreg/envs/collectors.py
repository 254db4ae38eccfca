"""Recording with TorchRL's collectors: many processes or machines, a shard of the data set each.

    worker w: ExpertEpisodesEnv ── frames ──> TorchRL collector ──> collect_shards ──> (w, episode), (w, episode), ...
              episodes w, w + W, w + 2 W, ...

The expert sits in the environment, which shows the action it would take, and the policy takes it: an expert may ask its
environment about the scene, which a policy of a collector cannot. Episode i comes from (seed, i), as in
:mod:`.collect`, and has the same bytes. Where one machine is enough :func:`~torchrl_ficreg.envs.collect_episodes` is
simpler and faster: it sends each frame once and shares out single episodes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, get_args, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import BaseCollector, MultiAsyncCollector
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_ficreg._utils import without_interrupts
from torchrl_ficreg.envs.base import GOAL_STATE
from torchrl_ficreg.envs.collect import EpisodeRecorder
from torchrl_ficreg.keys import ACTION, DONE, EPISODE, PIXELS, STATE, SUCCESS

CollectorKind = Literal["async", "ray", "submitit"]
EXPERT_ACTION, SHARD, AT_GOAL = "expert_action", "shard", "at_goal"
_FRAMES = 50  # of a worker, from one message to the next


class ExpertEpisodesEnv(EnvBase):
    """One worker's share of a data set, episode after episode; each reset begins the next.

    Root keys: ``pixels`` [3, H, W] uint8, ``state`` [S] float64, ``expert_action`` [A] float32, ``shard`` [1] int64,
    ``episode`` [1] int64, from 1, and ``at_goal`` [1] bool: the episode begins where it ends, no action is taken. Once
    the share is recorded episodes have number 0, hold zeros and end at once.

    Args:
        recorder: says what an episode is.
        indices: of the share, from 0.
        shard: its number.
    """

    def __init__(self, recorder: EpisodeRecorder, indices: Sequence[int], shard: int) -> None:
        super().__init__(batch_size=[])
        self.recorder, self.shard = replace(recorder), shard  # with an environment of its own
        self._indices = iter(indices)
        self._episode, self._taken = 0, 0
        space, action = self.recorder.env.observation_space, self.recorder.env.action_space.shape
        self.observation_spec = Composite(
            {
                PIXELS: Unbounded(space[PIXELS].shape, dtype=torch.uint8),
                STATE: Unbounded(space[STATE].shape, dtype=torch.float64),
                EXPERT_ACTION: Unbounded(action, dtype=torch.float32),
                SHARD: Unbounded((1,), dtype=torch.int64),
                EPISODE: Unbounded((1,), dtype=torch.int64),
                AT_GOAL: Binary(1, dtype=torch.bool),
            }
        )
        self.action_spec = Unbounded(action, dtype=torch.float32)
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        index = next(self._indices, None)
        self._episode, self._taken = 0 if index is None else index + 1, 0
        if index is None:
            return self._idle()
        _, self._expert, observation, info = self.recorder.begin(index)
        return self._observed(observation, info)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._episode == 0 or self._over:
            result = self._idle()
        else:
            self._taken += 1
            observation, _, _, _, info = self.recorder.env.step(tensordict[ACTION].numpy())
            result = self._observed(observation, info)
        return result.update({"reward": torch.zeros(1), "done": torch.tensor([self._episode == 0 or self._over])})

    def _observed(self, observation: dict[str, np.ndarray], info: dict[str, Any]) -> TensorDict:
        recorder = self.recorder
        solved = recorder.stop_at_success and bool(info[SUCCESS].item())
        self._over = solved or self._taken == recorder.max_steps
        result = self._idle()
        result[PIXELS], result[STATE] = torch.tensor(observation[PIXELS]), torch.tensor(observation[STATE])
        result[AT_GOAL] = torch.tensor([solved and self._taken == 0])
        if not self._over:
            action = self._expert(observation[STATE], observation[GOAL_STATE])
            result[EXPERT_ACTION] = torch.as_tensor(np.asarray(action, np.float32))
        return result

    def _idle(self) -> TensorDict:
        result = self.observation_spec.zero()
        result[SHARD], result[EPISODE] = torch.tensor([self.shard]), torch.tensor([self._episode])
        return result

    def _set_seed(self, seed: int | None) -> None:
        """Every episode has its own seed."""


def collect_shards(
    recorder: EpisodeRecorder,
    shares: Sequence[Sequence[int]],
    *,
    kind: CollectorKind = "async",
    options: dict[str, Any] | None = None,
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Records the shares of a data set, each in a process of its own.

    Args:
        recorder: says what an episode is.
        shares: the episodes' numbers, from 0, of each shard; some may be empty.
        kind: ``"async"`` for processes of this machine (:class:`~torchrl.collectors.MultiAsyncCollector`: no worker
            waits for another), ``"ray"`` for a Ray cluster, ``"submitit"`` for a SLURM cluster. A script needs the
            usual ``if __name__ == "__main__":``.
        options: further arguments of the collector, such as ``remote_configs`` of Ray or ``slurm_kwargs``.

    Yields:
        the number of a shard and its next episode, as :func:`~torchrl_ficreg.envs.collect_episodes` has them; in order
        within a shard. Closing the iterator stops the workers.

    Raises:
        ImportError: Ray or submitit is missing.
        ValueError: an unknown kind.
    """
    if kind not in get_args(CollectorKind):
        raise ValueError(f"unknown kind of collector {kind!r}: choose one of {get_args(CollectorKind)}.")
    left = {shard: len(share) for shard, share in enumerate(shares) if len(share)}
    if not left:
        return
    create = [functools.partial(ExpertEpisodesEnv, recorder, shares[shard], shard) for shard in left]
    with without_interrupts():
        collector = _make_collector(kind, create, options or {})
    begun: dict[int, list[TensorDictBase]] = {shard: [] for shard in left}
    try:
        for batch in collector:
            flat = batch.reshape(-1)
            for shard in flat[SHARD].unique().tolist():
                mine = flat[flat[SHARD].squeeze(-1) == shard].clone()  # the next batch of a worker overwrites this one
                for episode in _whole_episodes(begun[shard], mine):
                    left[shard] -= 1
                    yield shard, episode
            if not any(left.values()):
                return
    finally:
        collector.shutdown()


def _whole_episodes(begun: list[TensorDictBase], steps: TensorDictBase) -> Iterator[dict[str, np.ndarray]]:
    """Adds the next steps [N] of a worker to the episode it had begun, and yields those that end."""
    first = 0
    for end in steps[DONE].flatten().nonzero().flatten().tolist():
        episode = torch.cat([*begun, steps[first : end + 1]])  # [L - 1]
        begun.clear()
        first = end + 1
        if episode[EPISODE][0].item():
            yield _to_arrays(episode)
    if first < len(steps):
        begun.append(steps[first:])


def _to_arrays(episode: TensorDictBase) -> dict[str, np.ndarray]:
    """Steps [L - 1] -> rows [L], the last without an action."""
    if episode[AT_GOAL][0].item():
        rows = {key: episode[key][:1] for key in (PIXELS, STATE)}
        rows[ACTION] = torch.zeros_like(episode[ACTION][:1])
    else:
        rows = {key: torch.cat([episode[key], episode["next", key][-1:]]) for key in (PIXELS, STATE)}
        rows[ACTION] = torch.cat([episode[ACTION], torch.zeros_like(episode[ACTION][:1])])
    return {key: value.numpy() for key, value in rows.items()}


def _make_collector(kind: CollectorKind, create: list[Callable[[], EnvBase]], options: dict[str, Any]) -> BaseCollector:
    policy = TensorDictModule(nn.Identity(), in_keys=[EXPERT_ACTION], out_keys=[ACTION])
    settings = {"total_frames": -1, "frames_per_batch": _FRAMES, **options}
    if kind == "async":
        return MultiAsyncCollector(create, policy, **settings)
    try:
        if kind == "ray":
            import ray  # noqa: F401 (TorchRL's own message names no package)
            from torchrl.collectors.distributed import RayCollector as Distributed
        else:
            import submitit  # noqa: F401
            from torchrl.collectors.distributed import DistributedCollector as Distributed
    except ImportError as error:
        raise ImportError(f"collecting with {kind} needs a package: pip install {kind}, or collect with async.") from error
    launcher = {"launcher": "submitit"} if kind == "submitit" else {}
    return Distributed(create, policy, **launcher, **settings)
