"""The network of the goal policy: a latent and a goal latent to an action block."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

_SMALLEST_STD = 1e-6  # below it a latent dimension counts as constant


class GoalNetwork(nn.Module):
    """Hidden layers with LayerNorm on a standardised latent and goal latent.

    No BatchNorm: an imagined latent is answered as a real one is, alone or in company.

    Args:
        latent_dim: D.
        action_dim: width F * A of an action block.
        hidden_dim: of each hidden layer.
        depth: hidden layers.
    """

    def __init__(self, latent_dim: int, action_dim: int, hidden_dim: int = 512, depth: int = 3) -> None:
        super().__init__()
        sizes = {"latent_dim": latent_dim, "action_dim": action_dim, "hidden_dim": hidden_dim, "depth": depth}
        small = [f"{name}={size}" for name, size in sizes.items() if size < 1]
        if small:
            raise ValueError(f"sizes of a goal policy must be positive, got {', '.join(small)}.")
        self.latent_dim, self.action_dim, self.hidden_dim, self.depth = latent_dim, action_dim, hidden_dim, depth
        self.register_buffer("latent_mean", torch.zeros(latent_dim))
        self.register_buffer("latent_std", torch.ones(latent_dim))
        layers: list[nn.Module] = []
        for width in [2 * latent_dim] + [hidden_dim] * (depth - 1):
            layers += [nn.Linear(width, hidden_dim), nn.LayerNorm(hidden_dim), nn.GELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(hidden_dim, action_dim))

    def forward(self, latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """Latents [..., D] and goal latents [..., D] -> action blocks [..., F * A], z-scored.

        Raises:
            ValueError: other shapes.
        """
        if latent.shape != goal.shape or latent.shape[-1] != self.latent_dim:
            raise ValueError(
                f"the policy reads latents and goal latents [..., {self.latent_dim}] of one shape, got "
                f"{list(latent.shape)} and {list(goal.shape)}: was it trained for another world model?"
            )
        both = torch.stack([latent, goal], dim=-2)  # [..., 2, D]
        return self.layers(((both - self.latent_mean) / self.latent_std).flatten(-2))

    @property
    def sizes(self) -> dict[str, int]:
        """The arguments that build the same network."""
        return {name: getattr(self, name) for name in ("latent_dim", "action_dim", "hidden_dim", "depth")}

    @torch.no_grad()
    def standardize_by(self, latent: torch.Tensor) -> None:
        """Takes mean and standard deviation of its input from training latents [N, D].

        A dimension that never changes is only centred.

        Raises:
            ValueError: another width, fewer than two latents, or one that is not finite.
        """
        if latent.ndim != 2 or len(latent) < 2 or latent.shape[1] != self.latent_dim:
            raise ValueError(f"expected at least 2 latents [N, {self.latent_dim}], got {list(latent.shape)}.")
        rows = latent if latent.dtype in (torch.float32, torch.float64) else latent.float()
        rows = rows.cpu().numpy().astype(np.float64)  # summed in float64 by NumPy: MPS has none
        with np.errstate(invalid="ignore"):  # told below
            mean, std = rows.mean(0), rows.std(0)  # [D], [D]
        if not np.isfinite([mean, std]).all():
            raise ValueError("the training latents hold a NaN or an infinity: leave those rows out.")
        std[std < _SMALLEST_STD] = 1
        for buffer, value in ((self.latent_mean, mean), (self.latent_std, std)):
            buffer.copy_(torch.tensor(value.tolist(), dtype=buffer.dtype))
