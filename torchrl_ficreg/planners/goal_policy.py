"""Planner that returns the action sequence of a goal-conditioned policy; no search."""

from __future__ import annotations

from tensordict import TensorDict

from torchrl_ficreg.keys import PLAN, PLAN_COST
from torchrl_ficreg.planners.base import LatentPlanner, Problem


class GoalPolicyPlanner(LatentPlanner):
    """Returns what a goal-conditioned policy does (arXiv 2605.08732): one forward pass per block instead of a search.

    Blocks beyond the first are imagined: policy and world model alternate. With ``receding_horizon=1`` the policy acts on real
    frames only. See :class:`~torchrl_ficreg.LatentPlanner` for the entries that are read and written; without iterations
    there is no ``trace``. ``policy`` is required, and the settings are a :class:`~torchrl_ficreg.PlanConfig`. The scripts call
    this planner ``plan=policy``.

    Raises:
        ValueError: no policy, or ``num_proposals`` of 0.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import GoalPolicy, GoalPolicyPlanner, ModelConfig, PlanConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> config, policy = PlanConfig(horizon=1, receding_horizon=1), GoalPolicy(latent_dim=4, action_dim=10)
        >>> planner = GoalPolicyPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1]), policy=policy)
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 1, 10])
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        if self.policy is None or not self.config.num_proposals:
            raise ValueError("GoalPolicyPlanner needs a policy=, see train_policy.py, and num_proposals above 0.")

    def _apply_keys(self) -> None:
        super()._apply_keys()
        self.out_keys = self.out_keys[:3]  # no trace: there are no iterations

    def _search(self, problem: Problem) -> TensorDict:
        plan = problem.proposals[:, 0]  # [e, horizon, F * A]
        return TensorDict({PLAN: plan, PLAN_COST: problem.cost(plan.unsqueeze(1))[:, 0]}, [len(plan)])
