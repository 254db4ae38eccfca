"""Random shooting in latent space."""

from __future__ import annotations

import torch

from torchrl_ficreg.modules.planners.sampling import SamplingPlanner


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
