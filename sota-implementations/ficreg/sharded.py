"""Recording with TorchRL's collectors: a folder of shards instead of one dataset, opened the same way."""

from __future__ import annotations

import contextlib
import importlib.util
from pathlib import Path
from typing import Any, get_args

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_ficreg.data import EpisodeWriter
from torchrl_ficreg.data.shards import NUM_SHARDS, SHARD, shard_meta, SHARD_NUMBER
from torchrl_ficreg.envs.collect import EpisodeRecorder
from torchrl_ficreg.envs.collectors import collect_shards, CollectorKind
from torchrl_ficreg.envs.registry import find_entry


def record_shards(cfg: DictConfig, path: Path, meta: dict[str, Any]) -> Path:
    """Records what the shards of a dataset still lack, which may be nothing, and returns their folder.

    Shard w of W holds the episodes w, w + W, ...: opened together they are the dataset of one process. W is
    ``collect.num_workers``, at least one and at most the episodes, or what the shards that have begun say.

    Raises:
        ValueError: shards are there, unfinished, and no collector is named to go on with; or no collector wrote them.
    """
    begun, total = shard_meta(path), cfg.env.data.episodes
    check_collector(cfg.collect.collector)
    count = begun[NUM_SHARDS] if begun else min(max(1, cfg.collect.num_workers), total)
    shares = [range(shard, total, count) for shard in range(count)]
    for link in (path / SHARD.format(shard) for shard in range(count) if (path / SHARD.format(shard)).is_symlink()):
        raise ValueError(f"{link} is a link, through which nothing is written: put the shard in its place.")
    numbered = begun is None or SHARD_NUMBER in begun  # the first shards ever recorded are not
    with contextlib.ExitStack() as stack:
        writers = [
            stack.enter_context(
                EpisodeWriter(
                    path / SHARD.format(shard),
                    target_episodes=len(share),
                    meta={**meta, NUM_SHARDS: count, **({SHARD_NUMBER: shard} if numbered else {})},
                    frames=cfg.collect.frames,
                    wait=True,
                )
            )
            for shard, share in enumerate(shares)
        ]
        left = [share[writer.num_episodes :] for share, writer in zip(shares, writers)]
        if not any(left):
            return path
        if cfg.collect.collector is None:
            raise ValueError(f"{path} holds unfinished shards: give collect.collector=async, which continues them.")
        done = sum(writer.num_episodes for writer in writers)
        episodes = collect_shards(
            recorder(cfg), left, kind=cfg.collect.collector, options=OmegaConf.to_container(cfg.collect.options)
        )
        with tqdm(total=total, initial=done, desc="collect", unit="episode", dynamic_ncols=True) as bar:
            for shard, episode in episodes:
                writers[shard].append(episode)
                bar.update()
    return path


def check_collector(kind: str | None) -> None:
    """Finds out before a folder is made whether a collector exists.

    Raises:
        ImportError: its package is missing.
        ValueError: there is none of that name.
    """
    if kind is not None and kind not in get_args(CollectorKind):
        raise ValueError(f"unknown collect.collector {kind!r}: choose null or one of {list(get_args(CollectorKind))}.")
    if kind in ("ray", "submitit") and importlib.util.find_spec(kind) is None:
        raise ImportError(f"collect.collector={kind} needs a package: pip install {kind}, or give collect.collector=async.")


def recorder(cfg: DictConfig) -> EpisodeRecorder:
    """What an episode of a configuration is."""
    data = cfg.env.data
    env_kwargs = {**OmegaConf.to_container(cfg.env.kwargs), **OmegaConf.to_container(data.kwargs)}
    return EpisodeRecorder(
        entry=find_entry(cfg.env.name),
        seed=data.seed,
        max_steps=data.max_steps,
        stop_at_success=data.stop_at_success,
        expert_kwargs=OmegaConf.to_container(data.expert),
        env_kwargs={"image_size": cfg.model.image_size, **env_kwargs},
    )
