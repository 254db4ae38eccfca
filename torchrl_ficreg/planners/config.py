"""Settings that all planners share, and the ranges of all settings by name.

Each search defines a subclass of :class:`PlanConfig` with its own settings beside its planner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import get_args, get_origin, get_type_hints, Literal

from torchrl_ficreg._device import Precision

_LARGEST_COUNT = 10**6  # a larger one is a typing error
_POSITIVE = ("memory_budget", "std", "temperature", "learning_rate")
_AT_LEAST = {
    **dict.fromkeys(("num_candidates", "num_elites"), 2),
    **dict.fromkeys(("horizon", "receding_horizon", "min_time_to_go", "iterations", "decay"), 1),
    **dict.fromkeys(("time_to_go", "num_proposals", "proposal_std", "stop_std", "min_std", "noise_beta", "seed"), 0),
}


@dataclass(frozen=True)
class PlanConfig:
    """Settings that all planners share.

    The published evaluation (arXiv 2603.19312) has ``bounds="none"``, ``history="one_frame"`` and ``precision="fp32"``.

    Raises:
        ValueError: a value of another type or outside its range.
    """

    horizon: int = 5  # action blocks in a plan
    receding_horizon: int = 5  # action blocks executed before planning again, at most horizon
    bounds: Literal["environment", "none"] = "environment"  # of the actions
    history: Literal["context", "one_frame"] = "context"  # real frames that a rollout starts from: all it can use, or one
    warm_start: bool = True  # start from the blocks of the last plan that were not executed
    time_to_go: int = 0  # blocks from the start of an episode until its goal is due; 0: at the horizon of every plan
    min_time_to_go: int = 1  # of every plan, also of those made once the goal is due
    fallback: bool = False  # keep the rest of the last plan (needs warm_start), or act with zeros, where predicted to cost less
    num_proposals: int = 30  # candidates of the first iteration that a goal policy proposes, where there is one, at most
    proposal_std: float = 0.3  # of the noise on all proposals but the first, in z-scored actions
    precision: Precision = "auto"  # of the rollouts: "auto" (bf16 where that is fast, own networks as they are), "fp32" or "bf16"
    compile: bool = False  # torch.compile the rollouts; on CUDA with CUDA graphs
    memory_budget: float = 4.0  # GiB of GPU memory for rollouts; environments are planned in groups that fit
    seed: int = 0  # of the random draws
    trace: bool = False  # also return costs and std of every iteration

    def __post_init__(self) -> None:
        kinds = get_type_hints(type(self))
        for field in fields(self):
            _check(field.name, getattr(self, field.name), kinds[field.name])
        if self.receding_horizon > self.horizon:
            raise ValueError(f"receding_horizon must be at most horizon={self.horizon}, got {self.receding_horizon}.")


def _check(name: str, value: object, kind: object) -> None:
    """Raises a ValueError for a setting of another type or outside its range."""
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise ValueError(f"unknown {name} {value!r}: choose {' or '.join(map(repr, get_args(kind)))}.")
    elif kind not in (bool, int, float):
        return
    elif not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool) != (kind is bool):
        raise ValueError(f"{name} must be of type {kind.__name__}, got {value!r}.")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value}.")
    elif name in _POSITIVE and not value > 0:
        raise ValueError(f"{name} must be positive, got {value}.")
    elif value < _AT_LEAST.get(name, value):
        least = f"be at least {_AT_LEAST[name]}" if _AT_LEAST[name] else "not be negative"
        raise ValueError(f"{name} must {least}, got {value}.")
    elif kind is int and name != "seed" and value > _LARGEST_COUNT:
        raise ValueError(f"{name} must be at most {_LARGEST_COUNT}, got {value}.")
