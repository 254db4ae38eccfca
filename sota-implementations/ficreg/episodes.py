"""The dataset of a run: found, recorded, opened."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from sharded import record_shards, recorder
from torchrl import torchrl_logger
from tqdm import tqdm

from torchrl_ficreg._utils import nearest_folder, require_space
from torchrl_ficreg.data import EpisodeWriter, estimate_bytes, OfflineTrajectories
from torchrl_ficreg.data.dataset import split_episodes, SPLITS
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import open_store, shard_paths
from torchrl_ficreg.envs import collect_episodes, make_env
from torchrl_ficreg.envs.base import GOAL_STATE
from torchrl_ficreg.envs.registry import ENVIRONMENTS
from torchrl_ficreg.keys import STATE


def dataset_path(cfg: DictConfig) -> Path:
    """Where the dataset of a configuration lives."""
    data = cfg.env.data
    return Path(cfg.data_dir) / f"{cfg.env.name}_{cfg.model.image_size}px_{data.episodes}episodes_seed{data.seed}"


def find_dataset(cfg: DictConfig) -> Path:
    """The folder of the dataset: the one that was named, or ours with what it still lacks recorded.

    Raises:
        ValueError: the named one belongs to another environment, or has frames of another size or that are not square.
    """
    if cfg.dataset is None:
        return collect_dataset(cfg)
    store = open_store(Path(cfg.dataset).expanduser())
    env, (_, height, size) = store.header.meta.get("env"), store.header.shapes["pixels"]
    if env != cfg.env.name and env in ENVIRONMENTS:
        raise ValueError(f"the episodes of dataset={cfg.dataset} are of {env}: give env={env}.")
    if env != cfg.env.name:
        raise ValueError(
            f"the episodes of dataset={cfg.dataset} are of {env}, in which these scripts cannot plan (they can in "
            f"{sorted(ENVIRONMENTS)}): train on them in Python, with OfflineTrajectories and OfflineTrainer."
        )
    if height != size:
        raise ValueError(
            f"dataset={cfg.dataset} has frames of {height} x {size} pixels, the encoders see square ones: convert it again "
            f"into another target with image_size={min(height, size)}, which scales both sides to that."
        )
    if size != cfg.model.image_size:
        raise ValueError(
            f"dataset={cfg.dataset} has frames of {size} pixels: give model.image_size={size}, or convert it with "
            f"image_size={cfg.model.image_size}."
        )
    ours, theirs = OmegaConf.to_container(cfg.env.kwargs), store.header.meta.get("env_kwargs")
    theirs = theirs if isinstance(theirs, dict) else {}  # check_card() refuses what is no mapping
    differ = [f"{key}={theirs[key]}, not {value}" for key, value in ours.items() if theirs.get(key, value) != value]
    if differ:
        torchrl_logger.warning(
            f"dataset={cfg.dataset} was made with {'; '.join(differ)}: the run is evaluated with its own env.kwargs."
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
    if (whole or shard_paths(path)) and not is_writable(path):
        store = open_store(path)  # which must be complete
        differ = [name for name, value in json.loads(json.dumps(meta)).items() if store.header.meta.get(name) != value]
        if differ:
            raise ValueError(f"{path} was recorded with another {', '.join(differ)}: repeat those, or give another data_dir.")
        return path
    # Asked before the folder is made; what is there already needs no room, and is counted when the writer knows it.
    size = estimate_bytes(data.max_steps + 1, cfg.model.image_size, len(low), state_size, frames=cfg.collect.frames)
    if not path.exists():
        check_writable(path, "data_dir")
        require_space(path, data.episodes * size)
    if not whole and (cfg.collect.collector is not None or shard_paths(path)):
        return record_shards(cfg, path, meta)
    # Several runs may be started at once: one of them records, the others wait for it.
    frames = cfg.collect.frames
    with EpisodeWriter(path, target_episodes=data.episodes, meta=meta, frames=frames, wait=True) as writer:
        if writer.complete:
            return path
        if cfg.collect.collector is not None:
            raise ValueError(f"{path} was begun without a collector: leave out collect.collector, which continues it.")
        require_space(path, (data.episodes - writer.num_episodes) * size)
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


def is_writable(path: Path) -> bool:
    """Whether files can be made in a folder, or in the nearest one there is above it."""
    place = nearest_folder(path)
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)


def check_writable(path: Path, setting: str) -> None:
    """Finds out before the work whether its results can be written.

    Args:
        path: the folder they go to, which need not exist yet.
        setting: what names another.

    Raises:
        OSError: they cannot.
    """
    if not is_writable(path):
        raise OSError(f"{path} cannot be written (read-only, not yours, or below a file): give another {setting}=...")


def check_amounts(cfg: DictConfig) -> None:
    """Finds out before the recording whether it can be enough for a batch, for every split and for the pairs.

    Raises:
        ValueError: even if all episodes were of full length it would not be.
    """
    data, evaluation, rows = cfg.env.data, cfg.evaluation, cfg.env.data.max_steps + 1
    episodes = {split: len(split_episodes(data.episodes, split)) for split in SPLITS}
    if empty := [split for split, count in episodes.items() if not count]:
        raise ValueError(
            f"env.data.episodes={data.episodes} leave no episode for {' and '.join(empty)}: record more (20 are enough)."
        )
    clip = cfg.model.history * cfg.model.frame_skip  # steps from the first frame to the last
    clips = episodes["train"] * max(0, rows - clip)
    if clips < cfg.optim.batch_size:
        raise ValueError(
            f"{data.episodes} episodes of at most {data.max_steps} steps make at most {clips} training clips, less than "
            f"one batch of optim.batch_size={cfg.optim.batch_size}: lower it, or raise env.data.episodes."
        )
    wanted = {"evaluation": ("num_pairs", evaluation.num_pairs)}
    if evaluation.every:
        wanted["validation"] = ("every_pairs", evaluation.every_pairs)
    for split, (name, count) in wanted.items():
        starts = episodes[split] * max(0, rows - cfg.env.goal_offset)
        if starts < count:
            raise ValueError(
                f"cannot draw {count} pairs (evaluation.{name}) {cfg.env.goal_offset} steps apart: the {split} episodes will "
                f"have at most {starts} such starts. Collect more episodes, or ask for fewer pairs."
            )


def check_recording(cfg: DictConfig) -> None:
    """Builds environment and expert as a recording does, and takes one step, before anything is written.

    Raises:
        ValueError: their settings do not fit, or lead to actions that are not finite.
    """
    data = cfg.env.data
    settings = f"env.kwargs={cfg.env.kwargs}, env.data.kwargs={data.kwargs}, env.data.expert={data.expert}"
    record = recorder(cfg)
    try:
        env, expert, observation, _ = record.begin(0)
    except (TypeError, AttributeError) as error:  # of a constructor that has no such argument
        raise ValueError(f"{cfg.env.name} cannot be recorded with {settings}: {error}.") from error
    action = np.asarray(expert(observation[STATE], observation[GOAL_STATE]))
    if not np.isfinite(action).all():
        raise ValueError(f"the expert's first action is {action.tolist()}, which is not finite: see {settings}.")
    env.step(action)
    env.close()


def describe_env(cfg: DictConfig) -> tuple[list[float], list[float], int]:
    """Bounds of a raw action [A], environment units, and the size of the state."""
    try:
        env = make_env(cfg.env.name, image_size=cfg.model.image_size, **OmegaConf.to_container(cfg.env.kwargs))
    except TypeError as error:  # of a constructor that has no such argument
        raise ValueError(f"env.kwargs={cfg.env.kwargs} do not make {cfg.env.name}: {error}.") from error
    space = env.full_action_spec_unbatched["action"].space
    size = env.observation_spec["state"].shape[-1]
    env.close()
    return space.low.tolist(), space.high.tolist(), size
