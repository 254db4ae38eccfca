"""The loop that sampling searches share: draw candidates, imagine them, fit the next draw to the best."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_ficreg.modules.planners.common import LatentPlanner, PLAN, PLAN_COST, TRACE
from torchrl_ficreg.modules.planners.problem import Problem


class SamplingPlanner(LatentPlanner):
    """Base of searches that need nothing but costs; see :class:`~torchrl_ficreg.LatentPlanner`.

    Candidate 0 of every iteration is the current mean. In the first iteration a policy's proposals follow it, in later
    ones as many elites of the iteration before as the search keeps. Everything drawn is clamped to the bounds.
    """

    def _population(self) -> list[int]:
        """Candidates of each iteration."""
        return [self.config.num_candidates] * self.config.iterations

    def _kept(self) -> int:
        """Elites that compete again in the next iteration."""
        return 0

    def _colour(self, noise: torch.Tensor) -> torch.Tensor:
        """White noise [e, K, horizon, F * A] -> noise of unit variance."""
        return noise

    def _fit(
        self, elites: torch.Tensor, cost: torch.Tensor, mean: torch.Tensor, std: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Elites [e, N, horizon, F * A], best first, and their costs [e, N] -> new mean and std [e, horizon, F * A]."""
        raise NotImplementedError

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        """The plan [e, horizon, F * A] after the last iteration: its mean."""
        return mean

    def _search(self, problem: Problem) -> TensorDict:
        config, population = self.config, self._population()
        draws = self._colour(problem.noise(sum(population)))  # [e, sum of K, H, F * A]
        mean, std = problem.initial, torch.full_like(problem.initial, config.std)  # [e, H, F * A]
        elites = self._proposals(problem)
        done = torch.zeros(len(mean), dtype=torch.bool, device=mean.device)
        trace = []
        for iteration, noise in enumerate(draws.split(population, dim=1)):
            candidates = problem.clamp(mean.unsqueeze(1) + std.unsqueeze(1) * noise)  # [e, K, H, F * A]
            guests = elites if iteration == 0 else elites[:, : self._kept()]
            candidates[:, 0] = problem.clamp(mean)
            candidates[:, 1 : 1 + guests.shape[1]] = guests
            cost = problem.cost(candidates)  # [e, K]
            lowest, best = cost.topk(config.num_elites, dim=1, largest=False)  # [e, elites], ascending
            found = candidates.gather(1, best[..., None, None].expand(-1, -1, *mean.shape[1:]))  # [e, elites, H, F * A]
            fitted = self._fit(found, lowest, mean, std)
            row = (lowest[:, 0], lowest.mean(1), found.std(1).mean((-1, -2)))  # each [e]
            if config.stop_spread > 0:  # the only place that waits for the device
                keep = done[:, None, None]
                mean, std = (torch.where(keep, old, new) for old, new in zip((mean, std), fitted))
                elites = found if iteration == 0 else torch.where(keep.unsqueeze(1), elites, found)
                row = tuple(torch.where(done, torch.nan, value) for value in row)
                done = done | (found.std(1).amax((-1, -2)) < config.stop_spread)
            else:
                (mean, std), elites = fitted, found
            trace.append(row)
            if config.stop_spread > 0 and done.all():
                break
        plan = problem.clamp(self._choose(mean, elites))
        result = {PLAN: plan, PLAN_COST: problem.cost(plan.unsqueeze(1))[:, 0].clone()}
        if config.trace:
            result[TRACE] = _as_table(trace, config.iterations)
        return TensorDict(result, [len(plan)])

    def _proposals(self, problem: Problem) -> torch.Tensor:
        """What the policy would do, and that with noise [e, P, H, F * A]; P = 0 without a policy."""
        if problem.proposals is None:
            return problem.initial.unsqueeze(1)[:, :0]
        count = min(self.config.num_proposals, self.config.num_candidates - 1)
        noise = problem.noise(count) * self.config.proposal_std
        noise[:, 0] = 0.0
        return problem.clamp(problem.proposals + noise)


def _as_table(trace: list[tuple[torch.Tensor, ...]], iterations: int) -> TensorDict:
    """Rows of three tensors [e] -> columns [e, iterations], filled up with NaN."""
    names = ("best_cost", "elite_cost", "spread")
    columns = (torch.stack(column, dim=1) for column in zip(*trace))  # [e, rows]
    missing = iterations - len(trace)
    filled = (torch.nn.functional.pad(column, (0, missing), value=torch.nan) for column in columns)
    return TensorDict(dict(zip(names, filled)), [len(trace[0][0])])
