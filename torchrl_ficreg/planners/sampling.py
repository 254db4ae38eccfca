"""Variants of the cross-entropy method: iCEM, MPPI and random shooting. Read ``cem.py`` first, which has their loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from torchrl_ficreg.planners.cem import CEMConfig, SamplingPlanner
from torchrl_ficreg.planners.config import PlanConfig


@dataclass(frozen=True)
class ICEMConfig(CEMConfig):
    """Settings of iCEM. With the defaults, 100 x 10 candidates reach about what 300 x 30 of CEM reach.

    Raises:
        ValueError: a value of another type or outside its range.
    """

    num_candidates: int = 100  # of the first iteration
    num_elites: int = 10
    iterations: int = 10
    noise_beta: float = 2.0  # power spectrum f^-beta of the noise over raw actions: 0 white, 2 a random walk's
    kept_elites: float = 0.3  # fraction of the elites that is carried over to the next iteration
    decay: float = 1.25  # factor by which the number of candidates shrinks from one iteration to the next, at least 1
    momentum: float = 0.1  # weight of the old mean and std in the new ones

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0 <= self.kept_elites <= 1 and 0 <= self.momentum < 1):
            raise ValueError(
                f"kept_elites must lie in [0, 1] and momentum in [0, 1), got {self.kept_elites} and {self.momentum}."
            )


class LatentICEMPlanner(SamplingPlanner):
    """iCEM (arXiv 2008.06389): the cross-entropy method with a third of the candidates.

    It differs in five points. Noise is coloured along the raw actions of a whole plan, across its blocks, so that candidates are
    smooth. The best elites are carried over to the next iteration. Each iteration draws fewer candidates than the one before.
    Mean and std are updated with momentum. The plan is the best candidate of the last iteration. See
    :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written.

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

    def _num_carried_over(self) -> int:
        count = int(self.config.kept_elites * self.config.num_elites)
        return min(count, self._population()[-1] - 1)  # candidate 0 is the mean

    def _colour(self, noise: torch.Tensor) -> torch.Tensor:
        raw = noise.unflatten(-1, (self.world_model.frame_skip, -1)).flatten(2, 3)  # [e, K, H * F, A]
        return coloured(raw, self.config.noise_beta, dim=2).reshape(noise.shape)

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        new_mean, new_std = elites.mean(1), elites.std(1)
        return new_mean.lerp(mean, self.config.momentum), new_std.lerp(std, self.config.momentum)

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        return elites[:, 0]


@dataclass(frozen=True)
class MPPIConfig(CEMConfig):
    """Settings of MPPI.

    Raises:
        ValueError: a value of another type or outside its range.
    """

    num_elites: int = 60
    iterations: int = 10
    temperature: float = 0.5  # of the weights, in standard deviations of the elites' costs
    min_std: float = 0.05  # of every iteration, in z-scored actions, at most std

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_std > self.std:
            raise ValueError(f"min_std must be at most std={self.std}, got {self.min_std}.")


class LatentMPPIPlanner(SamplingPlanner):
    """MPPI (arXiv 1509.01149, with elites as in arXiv 2203.04955): fits the Gaussian to elites weighted by their costs.

    Weights are the softmax of -cost / (temperature x standard deviation of the elites' costs), so that the temperature does not
    depend on the units of the cost. The std never falls below ``config.min_std``. The plan is the last weighted mean. See
    :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written.

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
        scale = scale.clamp_min(torch.finfo(cost.dtype).tiny)  # elites on the same corner of the bounds have the same cost
        weight = torch.softmax((cost[:, :1] - cost) / scale, dim=1)[..., None, None]
        mean = (weight * elites).sum(1)
        variance = (weight * (elites - mean.unsqueeze(1)).square()).sum(1)
        return mean, variance.sqrt().clamp(self.config.min_std, self.config.std)


@dataclass(frozen=True)
class ShootingConfig(PlanConfig):
    """Settings of random shooting.

    Raises:
        ValueError: a value of another type or outside its range.
    """

    num_candidates: int = 300  # K, action sequences evaluated in one iteration, at least 2
    iterations: int = 30
    std: float = 1.0  # of the candidates, in z-scored actions

    num_elites: ClassVar[int] = 2  # described by the trace
    stop_std: ClassVar[float] = 0.0  # no early stop: nothing is fitted


class RandomShooting(SamplingPlanner):
    """The best of ``iterations x num_candidates`` random action sequences: a baseline for the other searches.

    Candidate 0 of every iteration is the initial plan, zeros by default, and the next one the best so far. See
    :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import ModelConfig, RandomShooting, ShootingConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> planner = RandomShooting(model.eval(), ShootingConfig(iterations=2), action_bounds=([-1, -1], [1, 1]))
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 5, 10])
    """

    config_class = ShootingConfig

    def _num_carried_over(self) -> int:
        return 1

    def _fit(self, elites, cost, mean, std) -> tuple[torch.Tensor, torch.Tensor]:
        return mean, std

    def _choose(self, mean: torch.Tensor, elites: torch.Tensor) -> torch.Tensor:
        return elites[:, 0]


def coloured(white: torch.Tensor, beta: float, dim: int) -> torch.Tensor:
    """Gives white noise a power spectrum f^-beta along one dimension and unit variance.

    The constant component has the power of the lowest frequency.

    Args:
        white (Tensor): standard normal draws, any shape.
        beta (float): 0 is white noise, 1 pink noise, 2 a random walk.
        dim (int): the dimension of time.

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
