"""Model-predictive control: one raw action per environment step, a new plan every few blocks."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_ficreg.keys import ACTION, GOAL_PIXELS, PIXELS
from torchrl_ficreg.modules.feed import require_tensordict
from torchrl_ficreg.planners.base import LatentPlanner, PAST_ACTION, PLAN, PLAN_COST, PLAN_SEED


class MPCPolicy(TensorDictModuleBase):
    """Serves one raw action per environment step; plans again after every ``receding_horizon`` blocks.

    Its memory travels in the tensordict, under ``"mpc"``: the raw actions still to be executed, how many were, how
    often was planned, the plan in force and the cost predicted for it. For a predictor that sees several frames it also
    holds the latents of the last real ones and the blocks executed between them; planning starts from as many as there
    are, from one frame on, and none is ever made up. Environments are independent: those that are fresh
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
        require_tensordict("MPCPolicy", tensordict)
        td = tensordict if tensordict.ndim else tensordict.unsqueeze(0)
        memory = self._memory(td)
        used_up = memory["cursor"] >= memory["queue"].shape[1]  # [E]
        remembers = self.planner.context > 1
        looks = memory["cursor"] % self.planner.world_model.frame_skip == 0 if remembers else used_up  # [E]
        if looks.any():
            latent = self._encode(td[PIXELS], looks)  # [E, D], zeros elsewhere
            if used_up.any():
                goal = self._encode(td[GOAL_PIXELS], used_up)
                memory[used_up] = self._plan(
                    latent[used_up], goal[used_up], memory[used_up], self._seeds(td)[used_up.cpu()]
                )
            if remembers:
                memory[looks] = self._remember(latent[looks], memory[looks])
        step = memory["cursor"]  # [E]
        action = memory["queue"][torch.arange(len(step), device=step.device), step]  # [E, A]
        memory["cursor"] = step + 1
        if not tensordict.ndim:
            action, memory = action[0], memory[0]
        return tensordict.set(ACTION, action.to(td[PIXELS].device)).set("mpc", memory)

    def _memory(self, td: TensorDictBase) -> TensorDict:
        """A copy of the memory, with fresh environments marked as used up.

        Counts lie where the environments are, which ask for them at every step; all else on the model's device.
        """
        config, model = self.planner.config, self.planner.world_model
        actions, envs, past = config.receding_horizon * model.frame_skip, len(td), self.planner.context - 1
        memory = td.get("mpc", None)
        if memory is None:
            zeros, like = torch.zeros(envs, dtype=torch.long, device=td.device), model.action_mean
            return TensorDict(
                {
                    "queue": like.new_zeros(envs, actions, len(like)),
                    "cursor": zeros + actions,
                    "count": zeros,
                    PLAN: like.new_zeros(envs, config.horizon, model.block_dim),
                    PLAN_COST: like.new_zeros(envs, dtype=torch.float32),  # half precision would round it
                    "past_latent": like.new_zeros(envs, past, model.latent_dim),
                    PAST_ACTION: like.new_zeros(envs, past, model.block_dim),
                    "past_count": zeros.clone(),
                },
                [envs],
            )
        memory = memory.clone()
        fresh = td.get("is_init", None)
        if fresh is not None:
            fresh = fresh.reshape(envs, -1).any(-1)
            memory["cursor"] = memory["cursor"].masked_fill(fresh, actions)
            for count in ("count", "past_count"):
                memory[count] = memory[count].masked_fill(fresh, 0)
        return memory

    @staticmethod
    def _seeds(td: TensorDictBase) -> torch.Tensor:
        seeds = td.get(PLAN_SEED, None)
        return torch.arange(len(td), device="cpu") if seeds is None else seeds.reshape(len(td)).cpu()

    @torch.no_grad()
    def _encode(self, pixels: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        """Frames [E, 3, H, W] -> latents [E, D] where wanted [E], zeros elsewhere."""
        model = self.planner.world_model
        latent = model.action_mean.new_zeros(len(pixels), model.latent_dim)
        latent[wanted] = model.encode(pixels[wanted].to(latent.device)).to(latent.dtype)
        return latent

    def _remember(self, latent: torch.Tensor, memory: TensorDict) -> TensorDict:
        """Memory of environments that are about to leave the frames of latents [e, D] by their next block."""
        model, past = self.planner.world_model, memory["past_latent"].shape[1]
        rows = torch.arange(len(latent), device=latent.device).unsqueeze(1)
        steps = memory["cursor"].unsqueeze(1).to(latent.device) + torch.arange(model.frame_skip, device=latent.device)  # [e, F]
        block = model.statistics.normalize(memory["queue"][rows, steps]).flatten(1)  # [e, F * A]
        memory["past_latent"] = torch.cat([memory["past_latent"], latent.unsqueeze(1)], dim=1)[:, 1:]
        memory[PAST_ACTION] = torch.cat([memory[PAST_ACTION], block.unsqueeze(1)], dim=1)[:, 1:]
        memory["past_count"] = (memory["past_count"] + 1).clamp_max(past)
        return memory

    def _plan(self, latent: torch.Tensor, goal: torch.Tensor, memory: TensorDict, seeds: torch.Tensor) -> TensorDict:
        """New memory of e environments whose present and goal are latents [e, D]."""
        model, config, device = self.planner.world_model, self.planner.config, latent.device
        mixed = [_mix(seed, count) for seed, count in zip(seeds.tolist(), memory["count"].tolist())]
        draws = torch.tensor(mixed, device="cpu")
        initial = self._rest_of_last_plan(memory)  # [e, horizon, F * A]
        result = TensorDict({PLAN: torch.zeros_like(initial), PLAN_COST: torch.zeros_like(memory[PLAN_COST])}, [len(latent)])
        for past in memory["past_count"].unique().tolist():  # a context of one frame has no past, and no padding either
            rows = memory["past_count"] == past
            first = memory["past_latent"].shape[1] - past
            context = torch.cat([memory["past_latent"][rows, first:], latent[rows].unsqueeze(1)], dim=1)  # [., C, D]
            found = self.planner.plan(
                context,
                goal[rows],
                draws[rows.cpu()],
                past_action=memory[PAST_ACTION][rows, first:],
                initial=initial[rows],
            )
            result[PLAN][rows] = found[PLAN].to(initial.dtype)
            result[PLAN_COST][rows] = found[PLAN_COST].to(result[PLAN_COST].dtype)
        blocks = result[PLAN][:, : config.receding_horizon]  # [e, R, F * A]
        queue = blocks.unflatten(-1, (model.frame_skip, -1)).flatten(1, 2)  # [e, R * F, A]
        queue = model.statistics.denormalize(queue)
        if self.planner.action_bounds is not None:  # undo the rounding of z-scoring forth and back
            queue = queue.clamp(*(bound.to(device) for bound in self.planner.action_bounds))
        count, queue = memory["count"] + 1, queue.to(memory["queue"].dtype)
        return memory.update({**result, "queue": queue, "cursor": torch.zeros_like(count), "count": count})

    def _rest_of_last_plan(self, memory: TensorDict) -> torch.Tensor:
        """The blocks of the last plan that were not executed, then mean actions: [e, horizon, F * A]."""
        last, executed = memory[PLAN], self.planner.config.receding_horizon
        rest = torch.cat([last[:, executed:], torch.zeros_like(last[:, :executed])], dim=1)
        begun = (memory["count"] > 0)[:, None, None].to(rest.device)
        return torch.where(begun, rest, 0.0) if self.planner.config.warm_start else torch.zeros_like(rest)


def _mix(seed: int, count: int) -> int:
    """One seed for the count-th plan of an environment."""
    return int(np.random.SeedSequence([seed % 2**63, count]).generate_state(1, np.uint64)[0] >> np.uint64(1))
