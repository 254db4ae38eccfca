"""Recording episodes and serving clips of them."""

from __future__ import annotations

from torchrl.data.datasets import register_dataset

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.data.clips import clip_length, ClipSampler, ClipStorage
from torchrl_ficreg.data.dataset import OfflineTrajectories, SeekableReplayBuffer, split_episodes
from torchrl_ficreg.data.layout import check_episode, estimate_bytes
from torchrl_ficreg.data.store import EpisodeStore
from torchrl_ficreg.data.writer import EpisodeWriter

__all__ = [
    "ActionStatistics",
    "ClipSampler",
    "ClipStorage",
    "EpisodeStore",
    "EpisodeWriter",
    "OfflineTrajectories",
    "SeekableReplayBuffer",
    "check_episode",
    "clip_length",
    "estimate_bytes",
    "split_episodes",
]

# Makes `torchrl.data.datasets.load_dataset("ficreg:<path>")` work; importing twice must not fail.
register_dataset("ficreg", "torchrl_ficreg.data:OfflineTrajectories", replace=True)
