"""Improved cross-entropy method: coloured noise, kept elites, a shrinking population."""

from __future__ import annotations

import torch

from torchrl_ficreg.modules.planners.config import ICEMConfig
from torchrl_ficreg.modules.planners.sampling import SamplingPlanner


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
