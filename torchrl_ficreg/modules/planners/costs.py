"""Costs of imagined trajectories: predictions [E, K, T, D] and goals [E, D] -> [E, K]."""

from __future__ import annotations

import torch
from torch import nn


class GoalDistance(nn.Module):
    """Squared distance of the last predicted latent from the goal (arXiv 2603.19312).

    Examples:
        >>> import torch
        >>> GoalDistance()(torch.ones(1, 3, 5, 4), torch.zeros(1, 4))
        tensor([[4., 4., 4.]])
    """

    def forward(self, predicted: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """[E, K, T, D] and [E, D] -> [E, K]."""
        return (predicted[:, :, -1] - goal.unsqueeze(1)).square().sum(-1)
