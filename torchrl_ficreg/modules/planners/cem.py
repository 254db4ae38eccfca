"""Cross-entropy method in latent space."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_ficreg.modules.planners.common import LatentPlanner, PLAN, PLAN_COST


class LatentCEMPlanner(LatentPlanner):
    """Cross-entropy method: samples action sequences, fits a Gaussian to the best, repeats.

    Starts from mean 0 and ``config.std`` in z-scored actions. Candidate 0 is the current mean; the others are drawn
    around it and clamped to the bounds. The plan is the last mean. See
    :class:`~torchrl_ficreg.modules.planners.common.LatentPlanner` for what is read and written.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import LatentCEMPlanner, ModelConfig, PlanConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> config = PlanConfig(num_candidates=16, num_elites=4, iterations=2)
        >>> planner = LatentCEMPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1]))
        >>> td = planner(TensorDict({"latent": torch.zeros(3, 4), "goal_latent": torch.ones(3, 4)}, [3]))
        >>> td["plan"].shape, td["action"].shape
        (torch.Size([3, 5, 10]), torch.Size([3, 10]))
    """

    def _search(self, latent: torch.Tensor, goal: torch.Tensor, seeds: list[int]) -> TensorDict:
        config = self.config
        envs, block = len(latent), self.world_model.predictor.module.action_dim
        noise = self._noise(seeds, (config.iterations, config.num_candidates, config.horizon, block), latent)
        bounds = self.block_bounds()
        mean = latent.new_zeros(envs, config.horizon, block)  # [e, H, F * A]
        std = torch.full_like(mean, config.std)
        if bounds is not None:
            mean = mean.clamp(*bounds)
        for iteration in range(config.iterations):
            candidates = mean.unsqueeze(1) + std.unsqueeze(1) * noise[:, iteration]  # [e, K, H, F * A]
            if bounds is not None:
                candidates = candidates.clamp(*bounds)
            candidates[:, 0] = mean
            cost = self._imagined_cost(latent, goal, candidates)  # [e, K]
            best = cost.topk(config.num_elites, dim=1, largest=False).indices  # [e, elites]
            elites = candidates[torch.arange(envs, device=best.device).unsqueeze(1), best]  # [e, elites, H, F * A]
            mean, std = elites.mean(1), elites.std(1)
        return TensorDict({PLAN: mean, PLAN_COST: self._imagined_cost(latent, goal, mean.unsqueeze(1))[:, 0]}, [envs])
