"""Feeds a replay buffer of clips to a TorchRL trainer, which asks for a collector."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer


class ReplayStream:
    """An endless stream of batches in the place of a collector; its position is its whole state.

    Args:
        replay_buffer: clips; its sampler can :meth:`seek` to a number of batches drawn.
        device: where batches go. Frames travel as uint8.
    """

    init_random_frames = 0

    def __init__(self, replay_buffer: ReplayBuffer, device: torch.device) -> None:
        self.replay_buffer, self.device = replay_buffer, device
        self.batches = 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            batch = self.replay_buffer.sample().to(self.device, non_blocking=True)
            self.batches += 1
            yield batch

    def state_dict(self) -> dict[str, Any]:
        """The number of batches drawn."""
        return {"batches": self.batches}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues after the batches already drawn."""
        self.batches = int(state_dict["batches"])
        self.replay_buffer.seek(self.batches)

    def set_seed(self, seed: int) -> int:
        """The sampler carries its own seed."""
        return seed

    def shutdown(self) -> None:
        """There is no process to end."""
