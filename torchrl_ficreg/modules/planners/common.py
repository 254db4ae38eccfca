"""What every latent planner shares: its settings, its bounds, its random draws and its place in TorchRL."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.modules import SafeModule
from torchrl.modules.planners import MPCPlannerBase

from torchrl_ficreg.data.schema import ACTION, GOAL_LATENT, LATENT
from torchrl_ficreg.modules.planners.costs import GoalDistance
from torchrl_ficreg.modules.precision import Precision, uses_bf16
from torchrl_ficreg.modules.world_model import LatentWorldModel

PLAN, PLAN_COST, PLAN_SEED = "plan", "plan_cost", "plan_seed"


@dataclass(frozen=True)
class PlanConfig:
    """Settings of a search. The defaults are the published evaluation of PushT (arXiv 2603.19312).

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
    precision: Precision = "auto"  # of the imagined rollouts: "auto", "fp32" or "bf16"
    seed: int = 0  # of the random draws

    def __post_init__(self) -> None:
        if not 2 <= self.num_elites <= self.num_candidates:
            raise ValueError(
                f"num_elites must lie between 2 and num_candidates={self.num_candidates}, got {self.num_elites}."
            )
        if self.iterations < 1 or self.horizon < 1 or not 1 <= self.receding_horizon <= self.horizon:
            raise ValueError(
                "iterations, horizon and receding_horizon must be positive and receding_horizon at most horizon, "
                f"got {self.iterations}, {self.horizon} and {self.receding_horizon}."
            )
        if not self.std > 0:
            raise ValueError(f"std must be positive, got {self.std}.")
        if self.bounds not in ("environment", "none"):
            raise ValueError(f"unknown bounds {self.bounds!r}: choose 'environment' or 'none'.")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}.")
        uses_bf16("cpu", self.precision)  # refuses an unknown one


class LatentPlanner(MPCPlannerBase):
    """Dynamics x cost x search: plans in latent space and never sees an environment.

    Reads ``latent`` [E, D] and ``goal_latent`` [E, D]; ``plan_seed`` [E] int64 names the random draws of each
    environment and defaults to 0, 1, ... Writes ``plan`` [E, horizon, F * A] z-scored, its predicted ``plan_cost`` [E]
    and, as TorchRL's planners do, the first block as ``action`` [E, F * A].

    Every environment draws from a generator of its own, on the CPU. On CPUs the search runs environment by environment
    as well (300 candidates fill the cores), so there a plan is the same to the last bit alone or among fifty;
    elsewhere the same up to the float kernels.

    Args:
        world_model: the dynamics; put it into ``eval()`` first.
        config: settings; :class:`PlanConfig`.
        action_bounds: (low [A], high [A]) in environment units; needed unless ``config.bounds`` is ``"none"``.
        cost: module from predictions [E, K, T, D] and goals [E, D] to costs [E, K];
            :class:`~torchrl_ficreg.modules.planners.costs.GoalDistance` when None.

    Raises:
        ValueError: bounds are missing or have another shape than the model's actions.
    """

    def __init__(
        self,
        world_model: LatentWorldModel,
        config: PlanConfig | None = None,
        *,
        action_bounds: tuple[Sequence[float], Sequence[float]] | None = None,
        cost: nn.Module | None = None,
    ) -> None:
        # MPCPlannerBase.__init__ wants an environment to imagine in; the world model takes its place.
        SafeModule.__init__(self, world_model, in_keys=[LATENT, GOAL_LATENT], out_keys=[ACTION])
        self.world_model = world_model
        self.config = PlanConfig() if config is None else config
        self.cost = GoalDistance() if cost is None else cost
        self.action_bounds = self._check_bounds(action_bounds)

    def _check_bounds(self, bounds) -> tuple[torch.Tensor, torch.Tensor] | None:
        if self.config.bounds == "none":
            return None
        if bounds is None:
            raise ValueError(
                "the planner needs action_bounds=(low, high) in environment units, or PlanConfig(bounds='none')."
            )
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in bounds)
        shape = self.world_model.action_mean.shape
        if low.shape != shape or high.shape != shape or not (low < high).all():
            raise ValueError(
                f"action_bounds must be low < high of shape {list(shape)}, got {low.tolist()} and {high.tolist()}: "
                "was the model trained for another environment?"
            )
        mean, std = self.world_model.action_mean.cpu(), self.world_model.action_std.cpu()
        # No distribution inside the bounds has a mean outside them or a std above half their distance.
        if ((mean < low) | (mean > high) | (std > (high - low) / 2 * 1.001)).any() and (std != 1).any():
            raise ValueError(
                f"the model's action statistics (mean {mean.tolist()}, std {std.tolist()}) cannot come from actions "
                f"between {low.tolist()} and {high.tolist()}: was the model trained for another environment?"
            )
        return low, high

    def block_bounds(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Bounds of a z-scored action block, (low [F * A], high [F * A]), or None."""
        if self.action_bounds is None:
            return None
        statistics, repeat = self.world_model.statistics, self.world_model.frame_skip
        return tuple(statistics.normalize(bound.to(statistics.mean.device)).repeat(repeat) for bound in self.action_bounds)

    def planning(self, td: TensorDictBase) -> torch.Tensor:
        """Writes ``plan`` and ``plan_cost`` into td and returns the first block [E, F * A]."""
        result = self.plan(td.get(LATENT), td.get(GOAL_LATENT), td.get(PLAN_SEED, None))
        td.update(result)
        return result[PLAN][:, 0]

    def forward(self, tensordict: TensorDictBase, tensordict_out: TensorDictBase | None = None) -> TensorDictBase:
        """See the class."""
        action = self.planning(tensordict)
        return self._write_to_tensordict(tensordict, (action,), tensordict_out)

    @torch.no_grad()
    def plan(self, latent: torch.Tensor, goal: torch.Tensor, seeds: torch.Tensor | None = None) -> TensorDict:
        """Searches a plan for every environment.

        Args:
            latent: [E, D].
            goal: [E, D].
            seeds: [E] int64, names of the random draws.

        Returns:
            ``plan`` [E, horizon, F * A], z-scored, and ``plan_cost`` [E], the cost predicted for it.

        Raises:
            ValueError: other shapes, or a world model in train mode.
        """
        if self.world_model.encoder.training or self.world_model.predictor.training:
            raise ValueError("the world model is in train mode, where dropout blurs every plan: call its eval().")
        seeds = range(len(latent)) if seeds is None else seeds.flatten().tolist()
        if latent.ndim != 2 or goal.shape != latent.shape or len(seeds) != len(latent):
            raise ValueError(
                f"expected latents [E, D], goals [E, D] and seeds [E], got {list(latent.shape)}, {list(goal.shape)} "
                f"and {len(seeds)}."
            )
        latent = latent.unsqueeze(1)  # [E, 1, D]: a context of one frame
        group = 1 if latent.device.type == "cpu" else max(1, len(latent))
        with self._dynamics_in_precision(latent.device):
            results = [
                self._search(latent[i : i + group], goal[i : i + group], seeds[i : i + group])
                for i in range(0, len(latent), group)
            ]
        return torch.cat(results)

    @contextmanager
    def _dynamics_in_precision(self, device: torch.device) -> Iterator[None]:
        """Swaps the predictor's weights for bfloat16 copies: autocast would cast them anew at every imagined step."""
        network = self.world_model.predictor.module
        if not uses_bf16(device, self.config.precision):
            yield
            return
        weights = TensorDict.from_module(network).detach().apply(_to_bf16)
        swap = weights.to_module(network, preserve_module_state=False).__enter__()
        try:
            yield
        finally:
            swap.__exit__(None, None, None)  # tensordict does not restore a module if told about an exception

    @abc.abstractmethod
    def _search(self, latent: torch.Tensor, goal: torch.Tensor, seeds: list[int]) -> TensorDict:
        """Latents [e, 1, D], goals [e, D], e seeds -> ``plan`` [e, horizon, F * A] and ``plan_cost`` [e]."""

    def _noise(self, seeds: list[int], shape: tuple[int, ...], like: torch.Tensor) -> torch.Tensor:
        """Standard normal draws [e, *shape] float32, each environment's from its own generator."""
        draws = []
        for seed in seeds:
            state = np.random.SeedSequence([self.config.seed, seed % 2**63]).generate_state(1, np.uint64)[0]
            generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
            draws.append(torch.randn(shape, generator=generator))
        return torch.stack(draws).to(like.device)

    def _imagined_cost(self, latent: torch.Tensor, goal: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Cost [e, K] of candidates [e, K, horizon, F * A] from latents [e, 1, D]."""
        start = latent.unsqueeze(1).expand(-1, action.shape[1], -1, -1)  # [e, K, 1, D]
        dtype = self.world_model.predictor.module.position.dtype
        predicted = self.world_model.rollout(start.to(dtype), action.to(dtype))  # [e, K, horizon, D]
        return self.cost(predicted.float(), goal)


def _to_bf16(value: torch.Tensor) -> torch.Tensor:
    return value.bfloat16() if value.is_floating_point() else value
