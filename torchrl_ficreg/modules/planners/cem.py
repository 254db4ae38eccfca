"""Cross-entropy method in latent space."""

from __future__ import annotations

import torch

from torchrl_ficreg.modules.planners.sampling import SamplingPlanner


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
