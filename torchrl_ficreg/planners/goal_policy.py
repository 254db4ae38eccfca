"""No search at all: the goal-conditioned policy's own plan."""

from __future__ import annotations

from tensordict import TensorDict

from torchrl_ficreg.planners.base import LatentPlanner, PLAN, PLAN_COST
from torchrl_ficreg.planners.problem import Problem


class PolicyPlanner(LatentPlanner):
    """Does what a goal-conditioned policy says (arXiv 2605.08732): one look instead of thousands of rollouts.

    Blocks beyond the first are imagined: policy and world model in turns. With ``receding_horizon=1`` every block
    follows a look at a real frame. See :class:`~torchrl_ficreg.LatentPlanner` for what is read and written; ``policy``
    is needed here.

    Examples:
        >>> import torch
        >>> from torchrl_ficreg import GoalPolicy, ModelConfig, PlanConfig, PolicyPlanner, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> config, policy = PlanConfig(horizon=1, receding_horizon=1), GoalPolicy(latent_dim=4, action_dim=10)
        >>> planner = PolicyPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1]), policy=policy)
        >>> planner.plan(torch.zeros(3, 4), torch.ones(3, 4))["plan"].shape
        torch.Size([3, 1, 10])
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        if self.policy is None or not self.config.num_proposals:
            raise ValueError("PolicyPlanner needs a policy=, see train_policy.py, and num_proposals above 0.")

    def _candidates(self) -> int:
        return 1

    def _search(self, problem: Problem) -> TensorDict:
        plan = problem.proposals[:, 0]  # [e, horizon, F * A]
        return TensorDict({PLAN: plan, PLAN_COST: problem.cost(plan.unsqueeze(1))[:, 0]}, [len(plan)])
