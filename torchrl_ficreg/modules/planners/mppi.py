"""Model predictive path integral control in latent space."""

from __future__ import annotations

import torch

from torchrl_ficreg.modules.planners.config import MPPIConfig
from torchrl_ficreg.modules.planners.sampling import SamplingPlanner


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
