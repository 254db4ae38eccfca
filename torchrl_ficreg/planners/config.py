"""Settings of the searches: frozen, checked when made, every number with its unit."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from torchrl_ficreg._device import check_precision, Precision

_LARGEST_COUNT = 10**6  # of candidates, iterations, blocks and proposals: a slip of the keyboard beyond


@dataclass(frozen=True)
class PlanConfig:
    """Settings that all searches share, and all of CEM's.

    The numbers are those of the published evaluation of PushT (arXiv 2603.19312); its ways with bounds, history and precision
    are ``bounds="none"``, ``history="one_frame"`` and ``precision="fp32"``.

    Raises:
        ValueError: a number outside its range.
    """

    num_candidates: int = 300  # K, action sequences tried in one iteration
    num_elites: int = 30  # best candidates that the next iteration is fitted to, at least 2
    iterations: int = 30
    horizon: int = 5  # action blocks imagined
    receding_horizon: int = 5  # action blocks executed before planning again, at most horizon
    std: float = 1.0  # of the first iteration, in z-scored actions
    bounds: Literal["environment", "none"] = "environment"  # "none" is the published evaluation
    history: Literal["context", "one_frame"] = "context"  # real frames the rollout starts from; "one_frame" as published
    warm_start: bool = True  # start from the blocks of the last plan that were not executed
    stop_spread: float = 0.0  # stop once the elites' std falls below this everywhere, z-scored; 0 never stops
    num_proposals: int = 30  # candidates of the first iteration that a policy proposes, where there is one, at most
    proposal_std: float = 0.3  # of the noise on all proposals but the first, in z-scored actions
    trace: bool = False  # also return cost and spread of every iteration
    precision: Precision = "auto"  # of the imagined rollouts: "auto" (bf16 where that is fast, own networks as they are), "fp32" or "bf16"
    compile: bool = False  # torch.compile the imagined rollouts; on CUDA with CUDA graphs
    memory_budget: float = 4.0  # GiB of a GPU that imagined rollouts may take; environments are planned in groups that fit
    seed: int = 0  # of the random draws

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            kinds = {"int": int, "float": (int, float), "bool": bool}.get(field.type)
            if kinds and (not isinstance(value, kinds) or isinstance(value, bool) != (kinds is bool)):
                raise ValueError(f"{field.name} must be of type {field.type}, got {value!r}.")
        if not 2 <= self.num_elites <= self.num_candidates:
            raise ValueError(
                f"num_elites must lie between 2 and num_candidates={self.num_candidates}, got {self.num_elites}."
            )
        if self.iterations < 1 or self.horizon < 1 or not 1 <= self.receding_horizon <= self.horizon:
            raise ValueError(
                "iterations, horizon and receding_horizon must be positive and receding_horizon at most horizon, "
                f"got {self.iterations}, {self.horizon} and {self.receding_horizon}."
            )
        for name in ("std", "memory_budget"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")
        for name in ("stop_spread", "num_proposals", "proposal_std", "seed"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}.")
        for field in fields(self):
            if field.type == "float" and math.isinf(getattr(self, field.name)):
                raise ValueError(f"{field.name} must be finite, got {getattr(self, field.name)}.")
        for name in ("num_candidates", "iterations", "horizon", "num_proposals"):
            if getattr(self, name) > _LARGEST_COUNT:
                raise ValueError(f"{name} must be at most {_LARGEST_COUNT}, got {getattr(self, name)}.")
        for name, choices in (("bounds", ("environment", "none")), ("history", ("context", "one_frame"))):
            if getattr(self, name) not in choices:
                raise ValueError(f"unknown {name} {getattr(self, name)!r}: choose {choices[0]!r} or {choices[1]!r}.")
        check_precision(self.precision)  # refuses an unknown one


@dataclass(frozen=True)
class ICEMConfig(PlanConfig):
    """Settings of iCEM. The defaults are the 100 x 10 that reach about what 300 x 30 of CEM do.

    Raises:
        ValueError: a number outside its range.
    """

    num_candidates: int = 100  # of the first iteration
    num_elites: int = 10
    iterations: int = 10
    noise_beta: float = 2.0  # power spectrum f^-beta of the noise over raw actions: 0 white, 2 a random walk's
    kept_elites: float = 0.3  # share of the elites that compete again in the next iteration
    decay: float = 1.25  # each iteration has this many times fewer candidates than the one before
    momentum: float = 0.1  # share of the old mean and std in the new ones

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.noise_beta >= 0 and 0 <= self.kept_elites <= 1 and self.decay >= 1 and 0 <= self.momentum < 1):
            raise ValueError(
                "noise_beta must not be negative, kept_elites lie in [0, 1], decay be at least 1 and momentum lie in "
                f"[0, 1), got {self.noise_beta}, {self.kept_elites}, {self.decay} and {self.momentum}."
            )


@dataclass(frozen=True)
class MPPIConfig(PlanConfig):
    """Settings of MPPI.

    Raises:
        ValueError: a number outside its range.
    """

    num_elites: int = 60
    iterations: int = 10
    temperature: float = 0.5  # of the weights, in standard deviations of the elites' costs
    min_std: float = 0.05  # of every iteration, in z-scored actions

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.temperature > 0 and 0 <= self.min_std <= self.std):
            raise ValueError(
                f"temperature must be positive and min_std lie between 0 and std={self.std}, got {self.temperature} "
                f"and {self.min_std}."
            )


@dataclass(frozen=True)
class GradientConfig(PlanConfig):
    """Settings of the gradient planner: ``num_candidates`` sequences descend side by side; there are no elites.

    Raises:
        ValueError: a number outside its range.
    """

    num_candidates: int = 16
    num_elites: int = 2  # not used
    learning_rate: float = 0.1  # of Adam, in z-scored actions

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}.")
        if self.stop_spread > 0:
            raise ValueError("gradient descent has no elites whose spread could stop it: leave stop_spread at 0.")
