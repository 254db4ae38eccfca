"""The dataset of a run: found, recorded, opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from sharded import record_shards
from tqdm import tqdm

from torchrl_ficreg.data import EpisodeWriter, estimate_bytes, OfflineTrajectories
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import open_store, shard_paths
from torchrl_ficreg.data.space import require_space
from torchrl_ficreg.envs import collect_episodes, make_env


def dataset_path(cfg: DictConfig) -> Path:
    """Where the dataset of a configuration lives."""
    data = cfg.env.data
    return Path(cfg.data_dir) / f"{cfg.env.name}_{cfg.model.image_size}px_{data.episodes}episodes_seed{data.seed}"


def find_dataset(cfg: DictConfig) -> Path:
    """The folder of the dataset: the one that was named, or ours with what it still lacks recorded.

    Raises:
        ValueError: the named one belongs to another environment or has frames of another size.
    """
    if cfg.dataset is None:
        return collect_dataset(cfg)
    store = open_store(Path(cfg.dataset))
    env, size = store.header.meta.get("env"), store.header.shapes["pixels"][-1]
    if env != cfg.env.name:
        raise ValueError(f"the episodes of dataset={cfg.dataset} are of {env}: give env={env}.")
    if size != cfg.model.image_size:
        raise ValueError(
            f"dataset={cfg.dataset} has frames of {size} pixels: give model.image_size={size}, or convert it with "
            f"image_size={cfg.model.image_size}."
        )
    return store.path


def collect_dataset(cfg: DictConfig) -> Path:
    """Records what the dataset still lacks, which may be nothing, and returns its folder.

    Raises:
        ValueError: a collector of TorchRL is named, and the dataset was begun without one.
    """
    path, data = dataset_path(cfg), cfg.env.data
    low, high, state_size = describe_env(cfg)
    meta = {
        "env": cfg.env.name,
        "env_kwargs": OmegaConf.to_container(cfg.env.kwargs),
        "record_kwargs": OmegaConf.to_container(data.kwargs),
        "expert": OmegaConf.to_container(data.expert),
        "image_size": cfg.model.image_size,
        "max_steps": data.max_steps,
        "stop_at_success": data.stop_at_success,
        "seed": data.seed,
        "action_low": low,
        "action_high": high,
    }
    whole = (path / META_FILE).exists()  # and no shards, whatever else lies there
    if not whole and (cfg.collect.collector is not None or shard_paths(path)):
        return record_shards(cfg, path, meta)
    # Several runs may be started at once: one of them records, the others wait for it.
    frames = cfg.collect.frames
    with EpisodeWriter(path, target_episodes=data.episodes, meta=meta, frames=frames, wait=True) as writer:
        if writer.complete:
            return path
        if cfg.collect.collector is not None:
            raise ValueError(f"{path} was begun without a collector: leave out collect.collector, which continues it.")
        steps = (data.episodes - writer.num_episodes) * (data.max_steps + 1)
        require_space(path, estimate_bytes(steps, cfg.model.image_size, len(low), state_size, frames=frames))
        episodes = collect_episodes(
            cfg.env.name,
            data.episodes,
            seed=data.seed,
            start=writer.num_episodes,
            num_workers=cfg.collect.num_workers,
            image_size=cfg.model.image_size,
            max_steps=data.max_steps,
            stop_at_success=data.stop_at_success,
            expert_kwargs=OmegaConf.to_container(data.expert),
            env_kwargs={**OmegaConf.to_container(cfg.env.kwargs), **OmegaConf.to_container(data.kwargs)},
        )
        first_step, done = writer.num_steps, writer.num_episodes
        with tqdm(total=data.episodes, initial=done, desc="collect", unit="episode", dynamic_ncols=True) as bar:
            for episode in episodes:
                writer.append(episode)
                bar.update()
                rate = (writer.num_steps - first_step) / max(bar.format_dict["elapsed"], 1e-9)
                bar.set_postfix_str(f"{rate:.0f} frames/s", refresh=False)
    return path


def make_dataset(cfg: DictConfig, path: Path, split: str, **changes: Any) -> OfflineTrajectories:
    """One split of a dataset as clips for the model of a configuration."""
    settings = {
        "split": split,
        "num_frames": cfg.model.history + 1,
        "frame_skip": cfg.model.frame_skip,
        "batch_size": cfg.optim.batch_size,
        "seed": cfg.seed,
        "pin_memory": True,  # where there is a CUDA device
    }
    return OfflineTrajectories(path.absolute(), **{**settings, **changes})


def describe_env(cfg: DictConfig) -> tuple[list[float], list[float], int]:
    """Bounds of a raw action [A], environment units, and the size of the state."""
    env = make_env(cfg.env.name, image_size=cfg.model.image_size, **OmegaConf.to_container(cfg.env.kwargs))
    space = env.full_action_spec_unbatched["action"].space
    size = env.observation_spec["state"].shape[-1]
    env.close()
    return space.low.tolist(), space.high.tolist(), size
