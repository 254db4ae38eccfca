"""Recorded episodes on disk, and clips of them for training."""

from __future__ import annotations

from torchrl.data.datasets import register_dataset

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.data.clips import clip_length, ClipSampler, ClipStorage
from torchrl_ficreg.data.dataset import OfflineTrajectories, split_episodes
from torchrl_ficreg.data.layout import check_episode, estimate_bytes
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.data.store import EpisodeStore
from torchrl_ficreg.data.writer import EpisodeWriter

__all__ = [
    "ActionStatistics",
    "ClipSampler",
    "ClipStorage",
    "EpisodeStore",
    "EpisodeWriter",
    "OfflineTrajectories",
    "check_episode",
    "clip_length",
    "estimate_bytes",
    "open_store",
    "split_episodes",
]

# Makes `torchrl.data.datasets.load_dataset("ficreg:<path>")` work; importing twice must not fail.
register_dataset("ficreg", "torchrl_ficreg.data:OfflineTrajectories", replace=True)
