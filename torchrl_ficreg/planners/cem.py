"""Cross-entropy method: its settings, the loop that all sampling searches share, and its update.

Read ``config.py`` and ``base.py`` first.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch.nn.functional import pad

from torchrl_ficreg.keys import PLAN, PLAN_COST, TRACE
from torchrl_ficreg.planners.base import LatentPlanner, Problem
from torchrl_ficreg.planners.config import PlanConfig


@dataclass(frozen=True)
class CEMConfig(PlanConfig):
    """Settings of the cross-entropy method, by default those of the published evaluation of PushT (arXiv 2603.19312).

    Raises:
        ValueError: a value of another type or outside its range.
    """

    num_candidates: int = 300  # K, action sequences evaluated in one iteration
    num_elites: int = 30  # best candidates, to which the next iteration is fitted; at least 2
    iterations: int = 30
    std: float = 1.0  # of the first iteration, in z-scored actions
    stop_std: float = 0.0  # stop once the elites' std is below this everywhere, in z-scored actions; 0 never stops

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_elites > self.num_candidates:
            raise ValueError(
                f"num_elites must lie between 2 and num_candidates={self.num_candidates}, got {self.num_elites}."
            )


class SamplingPlanner(LatentPlanner):
    """Base of the searches that sample candidates and refit a Gaussian; see :class:`~torchrl_ficreg.LatentPlanner`.

    Candidate 0 of every iteration is the current mean. It is followed by the proposals of a goal policy in the first
    iteration, and by the elites carried over from the iteration before in later ones. All candidates are clamped to the bounds.

    A subclass defines :meth:`_fit`, the update of the Gaussian.
    """

    config_class = CEMConfig

    def _search(self, problem: Problem) -> TensorDict:
        config, population = self.config, self._population()
        noise = self._colour(problem.noise(sum(population)))  # [e, sum of K, H, F * A]
        mean, std = problem.initial, torch.full_like(problem.initial, config.std)  # [e, H, F * A]
        carried_over, trace = self._proposals(problem), []  # [e, P, H, F * A]
        plan, stopped = mean, torch.zeros(len(mean), 1, 1, dtype=torch.bool, device=mean.device)
        for draws in noise.split(population, dim=1):  # [e, K, H, F * A]
            candidates = problem.clamp(mean.unsqueeze(1) + std.unsqueeze(1) * draws)  # [e, K, H, F * A]
            candidates[:, 0] = problem.clamp(mean)
            candidates[:, 1 : 1 + carried_over.shape[1]] = carried_over

            cost, best = problem.cost(candidates).topk(config.num_elites, dim=1, largest=False)  # [e, elites], ascending
            elites = candidates.gather(1, best[..., None, None].expand(-1, -1, *mean.shape[1:]))  # [e, elites, H, F * A]
            mean, std = self._fit(elites, cost, mean, std)
            carried_over = elites[:, : self._num_carried_over()]

            plan = torch.where(stopped, plan, self._choose(mean, elites))
            if config.trace:
                row = torch.stack([cost[:, 0], cost.mean(1), elites.std(1).mean((-1, -2))], dim=1)  # [e, 3]
                trace.append(torch.where(stopped[:, 0], torch.nan, row))
            if config.stop_std > 0:
                stopped = stopped | (elites.std(1).amax((-1, -2), keepdim=True) < config.stop_std)
                if stopped.all():  # the only synchronisation with the device
                    break
        plan = problem.clamp(plan)
        result = {PLAN: plan, PLAN_COST: problem.cost(plan.unsqueeze(1))[:, 0].clone()}
        if config.trace:
            columns = pad(torch.stack(trace, dim=-1), (0, config.iterations - len(trace)), value=torch.nan).unbind(1)
            result[TRACE] = TensorDict(dict(zip(("best_cost", "elite_cost", "std"), columns)), [len(plan)])
        return TensorDict(result, [len(plan)])

    @abc.abstractmethod
    def _fit(
        self, elites: torch.Tensor, cost: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Elites [e, N, H, F * A], best first, and their costs [e, N] -> new mean and std [e, H, F * A]."""

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        """The plan [e, H, F * A] after an iteration: its new mean."""
        return mean

    def _population(self) -> list[int]:
        """Candidates of each iteration."""
        return [self.config.num_candidates] * self.config.iterations

    def _num_carried_over(self) -> int:
        """Elites that are candidates again in the next iteration."""
        return 0

    def _colour(self, noise: torch.Tensor) -> torch.Tensor:
        """White noise [e, K, H, F * A] -> noise of unit variance."""
        return noise

    def _proposals(self, problem: Problem) -> torch.Tensor:
        """The plan of the goal policy, without and with noise [e, P, H, F * A]; P = 0 without a policy."""
        if problem.proposals is None:
            return problem.initial.unsqueeze(1)[:, :0]
        count = min(self.config.num_proposals, self.config.num_candidates - 1)
        noise = problem.noise(count) * self.config.proposal_std
        noise[:, 0] = 0.0
        return problem.clamp(problem.proposals + noise)


class LatentCEMPlanner(SamplingPlanner):
    """Cross-entropy method: samples action sequences, fits a Gaussian to the best, repeats.

    Starts from mean 0 and ``config.std`` in z-scored actions. The plan is the last mean. See
    :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import CEMConfig, LatentCEMPlanner, ModelConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> config = CEMConfig(num_candidates=16, num_elites=4, iterations=2)
        >>> planner = LatentCEMPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1]))
        >>> td = planner(TensorDict({"latent": torch.zeros(3, 4), "goal_latent": torch.ones(3, 4)}, [3]))
        >>> td["plan"].shape, td["action"].shape
        (torch.Size([3, 5, 10]), torch.Size([3, 10]))
    """

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        return elites.mean(1), elites.std(1)
