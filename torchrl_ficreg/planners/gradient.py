"""Gradient descent through the world model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict

from torchrl_ficreg.keys import PLAN, PLAN_COST, TRACE
from torchrl_ficreg.planners.base import LatentPlanner, Problem
from torchrl_ficreg.planners.config import PlanConfig


@dataclass(frozen=True)
class GradientConfig(PlanConfig):
    """Settings of the gradient planner.

    Raises:
        ValueError: a value of another type or outside its range.
    """

    num_candidates: int = 16  # action sequences optimised side by side, at least 2
    iterations: int = 30  # steps of Adam
    std: float = 1.0  # of the action sequences at the start, in z-scored actions
    learning_rate: float = 0.1  # of Adam, in z-scored actions


class GradientPlanner(LatentPlanner):
    """Minimises the imagined cost with Adam, from several random action sequences side by side; the best one is the plan.

    Every step is followed by a projection into the bounds. Costs of latent world models have many local minima: expect less
    than from the cross-entropy method. See :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written;
    ``elite_cost`` and ``std`` of the trace are those of all candidates.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import GradientConfig, GradientPlanner, ModelConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> planner = GradientPlanner(model.eval(), GradientConfig(iterations=3), action_bounds=([-1, -1], [1, 1]))
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 5, 10])
    """

    config_class = GradientConfig
    needs_gradient = True

    def _search(self, problem: Problem) -> TensorDict:
        config = self.config
        noise = config.std * problem.noise(config.num_candidates)  # [e, K, H, F * A]
        noise[:, 0] = 0.0
        candidates = problem.clamp(problem.initial.unsqueeze(1) + noise)
        if problem.proposals is not None:
            candidates[:, 1:2] = problem.proposals
        optimizer = torch.optim.Adam([candidates.requires_grad_()], lr=config.learning_rate)
        trace = []
        for _ in range(config.iterations):
            with torch.enable_grad():
                cost = problem.cost(candidates)  # [e, K]
                if not cost.requires_grad:
                    raise ValueError(
                        "the cost has no gradient with respect to the actions, which GradientPlanner needs: remove what "
                        "detaches it in the predictor or the cost, or use LatentCEMPlanner."
                    )
                (candidates.grad,) = torch.autograd.grad(cost.sum(), candidates)
            trace.append((cost.detach().amin(1), cost.detach().mean(1), candidates.detach().std(1).mean((-1, -2))))
            optimizer.step()
            candidates.data = problem.clamp(candidates.data)
        candidates = candidates.detach()
        best = problem.cost(candidates).argmin(1)  # [e]
        plan = candidates[torch.arange(len(best), device=best.device), best]  # [e, H, F * A]
        result = {PLAN: plan, PLAN_COST: problem.cost(plan.unsqueeze(1))[:, 0]}
        if config.trace:
            names = ("best_cost", "elite_cost", "std")
            columns = (torch.stack(column, dim=1).detach() for column in zip(*trace))
            result[TRACE] = TensorDict(dict(zip(names, columns)), [len(best)])
        return TensorDict(result, [len(best)]).detach()
