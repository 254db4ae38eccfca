"""Model-predictive control: one raw action per environment step, a new plan every few blocks."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_ficreg.data.schema import ACTION, GOAL_PIXELS, PIXELS
from torchrl_ficreg.modules.planners.common import LatentPlanner, PLAN, PLAN_COST, PLAN_SEED


class MPCPolicy(TensorDictModuleBase):
    """Serves one raw action per environment step; plans again after every ``receding_horizon`` blocks.

    Its memory travels in the tensordict, under ``"mpc"``: the raw actions still to be executed, how many were, how
    often was planned, and the cost predicted for the plan in force. Environments are independent: those that are fresh
    (no memory yet, or ``is_init`` true) or whose queue is used up are planned for, the others are left alone. Where
    environments reset themselves, append TorchRL's ``InitTracker``, which writes ``is_init``: without it the old
    episode's actions go on.
    ``plan_seed`` [E] int64 names each environment's random draws (0, 1, ... when absent), so a plan depends neither on
    who else is planned for nor on when.

    Reads ``pixels`` and ``goal_pixels`` [E, 3, H, W], writes ``action`` [E, A] in environment units.

    Args:
        planner: the search; its world model encodes the frames.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import LatentCEMPlanner, ModelConfig, MPCPolicy, PlanConfig, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> config = PlanConfig(num_candidates=8, num_elites=2, iterations=1)
        >>> policy = MPCPolicy(LatentCEMPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1])))
        >>> frame = torch.zeros(2, 3, 64, 64, dtype=torch.uint8)
        >>> policy(TensorDict({"pixels": frame, "goal_pixels": frame}, [2]))["action"].shape
        torch.Size([2, 2])
    """

    def __init__(self, planner: LatentPlanner) -> None:
        super().__init__()
        self.planner = planner
        self.in_keys, self.out_keys = [PIXELS, GOAL_PIXELS], [ACTION, "mpc"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See the class."""
        td = tensordict if tensordict.ndim else tensordict.unsqueeze(0)
        memory = self._memory(td)
        used_up = memory["cursor"] >= memory["queue"].shape[1]  # [E]
        if used_up.any():
            memory[used_up] = self._plan(td[used_up], memory[used_up], self._seeds(td)[used_up.cpu()])
        step = memory["cursor"]  # [E]
        action = memory["queue"][torch.arange(len(step), device=step.device), step]  # [E, A]
        memory["cursor"] = step + 1
        if not tensordict.ndim:
            action, memory = action[0], memory[0]
        return tensordict.set(ACTION, action).set("mpc", memory)

    def _memory(self, td: TensorDictBase) -> TensorDict:
        """A copy of the memory, with fresh environments marked as used up."""
        config, model = self.planner.config, self.planner.world_model
        actions = config.receding_horizon * model.frame_skip
        memory = td.get("mpc", None)
        if memory is None:
            zeros = torch.zeros(len(td), dtype=torch.long, device=td.device)
            queue = model.action_mean.new_zeros(len(td), actions, len(model.action_mean))
            cost = queue.new_zeros(len(td))
            return TensorDict({"queue": queue, "cursor": zeros + actions, "count": zeros, PLAN_COST: cost}, [len(td)])
        memory = memory.clone()
        fresh = td.get("is_init", None)
        if fresh is not None:
            fresh = fresh.reshape(len(td), -1).any(-1)
            memory["cursor"] = memory["cursor"].masked_fill(fresh, actions)
            memory["count"] = memory["count"].masked_fill(fresh, 0)
        return memory

    @staticmethod
    def _seeds(td: TensorDictBase) -> torch.Tensor:
        seeds = td.get(PLAN_SEED, None)
        return torch.arange(len(td)) if seeds is None else seeds.reshape(len(td)).cpu()

    @torch.no_grad()
    def _plan(self, td: TensorDictBase, memory: TensorDict, seeds: torch.Tensor) -> TensorDict:
        """New memory of the environments in td [e]."""
        model = self.planner.world_model
        device = model.action_mean.device
        latent = model.encode(td[PIXELS].to(device))  # [e, D]
        goal = model.encode(td[GOAL_PIXELS].to(device))  # [e, D]
        draws = [_mix(seed, count) for seed, count in zip(seeds.tolist(), memory["count"].tolist())]
        result = self.planner.plan(latent, goal, torch.tensor(draws))
        blocks = result[PLAN][:, : self.planner.config.receding_horizon]  # [e, R, F * A]
        queue = blocks.unflatten(-1, (model.frame_skip, -1)).flatten(1, 2)  # [e, R * F, A]
        queue = model.statistics.denormalize(queue)
        if self.planner.action_bounds is not None:  # undo the rounding of z-scoring forth and back
            queue = queue.clamp(*(bound.to(device) for bound in self.planner.action_bounds))
        count = memory["count"] + 1
        new = {"queue": queue, "cursor": torch.zeros_like(count), "count": count, PLAN_COST: result[PLAN_COST]}
        return TensorDict(new, [len(td)])


def _mix(seed: int, count: int) -> int:
    """One seed for the count-th plan of an environment."""
    return int(np.random.SeedSequence([seed % 2**63, count]).generate_state(1, np.uint64)[0] >> np.uint64(1))
