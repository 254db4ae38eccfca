"""The loop that sampling searches share: draw candidates, imagine them, fit the next draw to the best."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_ficreg.planners.base import LatentPlanner, PLAN, PLAN_COST, TRACE
from torchrl_ficreg.planners.config import ICEMConfig, MPPIConfig
from torchrl_ficreg.planners.problem import Problem


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


class LatentCEMPlanner(SamplingPlanner):
    """Cross-entropy method: samples action sequences, fits a Gaussian to the best, repeats.

    Starts from mean 0 and ``config.std`` in z-scored actions. Candidate 0 is the current mean; the others are drawn
    around it and clamped to the bounds. The plan is the last mean. See :class:`~torchrl_ficreg.LatentPlanner` for what
    is read and written.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import LatentCEMPlanner, ModelConfig, PlanConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> config = PlanConfig(num_candidates=16, num_elites=4, iterations=2, num_proposals=2)
        >>> planner = LatentCEMPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1]))
        >>> td = planner(TensorDict({"latent": torch.zeros(3, 4), "goal_latent": torch.ones(3, 4)}, [3]))
        >>> td["plan"].shape, td["action"].shape
        (torch.Size([3, 5, 10]), torch.Size([3, 10]))
    """

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        return elites.mean(1), elites.std(1)


class LatentICEMPlanner(SamplingPlanner):
    """iCEM (arXiv 2008.06389): the cross-entropy method with a third of the candidates.

    Noise is coloured along the raw actions of a whole plan, block after block, so that candidates keep a direction
    instead of trembling; the best elites compete again; each iteration draws fewer candidates than the one before; mean
    and std move with momentum; and the plan is the best candidate of the last iteration. See
    :class:`~torchrl_ficreg.LatentPlanner` for what is read and written.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import ICEMConfig, LatentICEMPlanner, ModelConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> planner = LatentICEMPlanner(model.eval(), ICEMConfig(iterations=3), action_bounds=([-1, -1], [1, 1]))
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 5, 10])
    """

    config_class = ICEMConfig

    def _population(self) -> list[int]:
        config = self.config
        smallest = min(config.num_candidates, 2 * config.num_elites)
        sizes = (int(config.num_candidates / config.decay**iteration) for iteration in range(config.iterations))
        return [max(smallest, size) for size in sizes]

    def _kept(self) -> int:
        kept = int(self.config.kept_elites * self.config.num_elites)
        return min(kept, self._population()[-1] - 1)  # candidate 0 is the mean

    def _colour(self, noise: torch.Tensor) -> torch.Tensor:
        raw = noise.unflatten(-1, (self.world_model.frame_skip, -1)).flatten(2, 3)  # [e, K, H * F, A]
        return coloured(raw, self.config.noise_beta, dim=2).reshape(noise.shape)

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        new_mean, new_std = elites.mean(1), elites.std(1)
        return new_mean.lerp(mean, self.config.momentum), new_std.lerp(std, self.config.momentum)

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        return elites[:, 0]


def coloured(white: torch.Tensor, beta: float, dim: int) -> torch.Tensor:
    """Gives white noise a power spectrum f^-beta along one dimension and unit variance.

    The constant component has the power of the lowest frequency.

    Args:
        white: standard normal draws.
        beta: 0 leaves it white, 1 is pink, 2 a random walk's.
        dim: of time.

    Returns:
        noise of the same shape.

    Examples:
        >>> import torch
        >>> noise = coloured(torch.randn(20_000, 25, generator=torch.Generator().manual_seed(0)), 2.0, dim=1)
        >>> round(noise.var().item(), 1), bool((noise[:, 1:] * noise[:, :-1]).mean() > 0.8)
        (1.0, True)
    """
    length = white.shape[dim]
    if beta == 0 or length == 1:
        return white
    frequency = torch.fft.fftfreq(length, device=white.device, dtype=white.dtype).abs()  # [length]
    scale = frequency.clamp_min(1 / length) ** (-beta / 2)
    scale = scale / scale.square().mean().sqrt()
    half = scale[: length // 2 + 1].view(-1, *[1] * (white.ndim - 1 - dim % white.ndim))
    return torch.fft.irfft(torch.fft.rfft(white, dim=dim) * half, n=length, dim=dim)


class LatentMPPIPlanner(SamplingPlanner):
    """MPPI (arXiv 1509.01149, with elites as in arXiv 2203.04955): every elite counts, better ones more.

    Weights are the softmax of -cost / (temperature x standard deviation of the elites' costs), so that one temperature
    serves every cost and every iteration. The std never falls below ``config.min_std``. The plan is the last weighted
    mean. See :class:`~torchrl_ficreg.LatentPlanner` for what is read and written.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import LatentMPPIPlanner, ModelConfig, MPPIConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> planner = LatentMPPIPlanner(model.eval(), MPPIConfig(iterations=3), action_bounds=([-1, -1], [1, 1]))
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 5, 10])
    """

    config_class = MPPIConfig

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        scale = self.config.temperature * cost.std(1, keepdim=True)  # [e, 1]
        scale = scale.clamp_min(torch.finfo(cost.dtype).tiny)  # elites on the same corner of the bounds cost the same
        weight = torch.softmax((cost[:, :1] - cost) / scale, dim=1)[..., None, None]
        mean = (weight * elites).sum(1)
        variance = (weight * (elites - mean.unsqueeze(1)).square()).sum(1)
        return mean, variance.sqrt().clamp(self.config.min_std, self.config.std)


class RandomShooting(SamplingPlanner):
    """The best of ``iterations x num_candidates`` random action sequences: what any search has to beat.

    In every iteration one of them is standing still and one the best so far.

    See :class:`~torchrl_ficreg.LatentPlanner` for what is read and written.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import ModelConfig, PlanConfig, RandomShooting, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> planner = RandomShooting(model.eval(), PlanConfig(iterations=2), action_bounds=([-1, -1], [1, 1]))
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 5, 10])
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        if self.config.stop_spread > 0:
            raise ValueError("random shooting fits nothing that could settle: leave stop_spread at 0.")

    def _kept(self) -> int:
        return 1

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        return mean, std

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        return elites[:, 0]
