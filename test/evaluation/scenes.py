"""TwoRoom scenes that a straight walk solves, recorded episodes, and policies that see the state."""

from __future__ import annotations

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.evaluation import StartGoalPairs


def make_pairs(starts, goals, **changes) -> StartGoalPairs:
    """Pairs of given states, as if drawn from a dataset."""
    values = {
        "env": "two_room",
        "goal_offset": 5,
        "seed": 0,
        "fingerprint": "f" * 64,
        "episode": np.arange(1, len(starts) + 1),
        "step": np.zeros(len(starts), dtype=np.int64),
        "start_state": np.array(starts, dtype=np.float64),
        "goal_state": np.array(goals, dtype=np.float64),
    }
    return StartGoalPairs(**{**values, **changes})


def same_room_pairs(count: int = 7) -> StartGoalPairs:
    """Starts and goals in the left room, 30 to 150 px apart."""
    rng = np.random.default_rng(0)
    starts, goals = rng.uniform([25, 25], [95, 60], (count, 2)), rng.uniform([25, 150], [95, 200], (count, 2))
    return make_pairs(starts, goals)


def make_dataset(split: str = "evaluation", episodes: int = 40, length: int = 12, seed: int = 0) -> OfflineTrajectories:
    """Episodes whose state is (episode + a third, step + a seventh): no short decimal fraction."""
    recorded = [
        {
            "pixels": np.full((length + number % 3, 3, 8, 8), (number + seed) % 256, dtype=np.uint8),
            "action": np.pad(np.ones((length + number % 3 - 1, 2)), ((0, 1), (0, 0))).astype(np.float32),
            "state": np.stack([np.full(length + number % 3, number + 1 / 3), np.arange(length + number % 3) + 1 / 7], 1),
        }
        for number in range(1, episodes + 1)
    ]
    return OfflineTrajectories.from_episodes(recorded, split=split, num_frames=2, frame_skip=1)


class Walker(TensorDictModuleBase):
    """Walks straight from ``state`` to ``goal_state``, one full step at most, and on in the last direction if told."""

    def __init__(self, stop: bool = True) -> None:
        super().__init__()
        self.in_keys, self.out_keys, self.stop = ["state", "goal_state"], ["action"], stop

    def forward(self, tensordict):
        """Writes ``action``."""
        if self.stop:
            action = ((tensordict["goal_state"] - tensordict["state"]) / 5).clamp(-1, 1)
        else:
            action = torch.zeros_like(tensordict["state"])
            action[..., 1] = 1.0
        return tensordict.set("action", action.float())
