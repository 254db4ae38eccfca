"""Model-predictive control: one raw action per environment step, a new plan every few action blocks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from torchrl_ficreg.keys import (
    ACTION,
    GOAL_PIXELS,
    IS_INIT,
    MPC_MEMORY,
    PAST_ACTION,
    PAST_LATENT,
    PIXELS,
    PLAN,
    PLAN_COST,
    PLAN_SEED,
)
from torchrl_ficreg.modules.feed import require_tensordict
from torchrl_ficreg.modules.keyed import KeyedMixin
from torchrl_ficreg.planners.base import LatentPlanner, mix_seeds


class MPCPolicy(KeyedMixin, TensorDictModuleBase):
    """Executes plans action by action and plans again after every ``receding_horizon`` blocks.

    Reads ``pixels`` and ``goal_pixels`` [E, 3, H, W], and where they are present ``is_init`` [E, 1] bool and ``plan_seed`` [E]
    int64. Writes ``action`` [E, A] in environment units and its memory as ``mpc``. All keys can be changed with
    :meth:`set_keys`.

    The memory travels in the tensordict, so that one policy can serve several rollouts. It is a tensordict with:

    * ``queue`` [E, receding_horizon * F, A]: the raw actions of the plan, and ``cursor`` [E]: how many were executed;
    * ``count`` [E]: plans so far in the episode;
    * ``plan`` [E, horizon, F * A] and ``plan_cost`` [E]: the last plan, z-scored, and its predicted cost;
    * ``past_latent`` [E, C - 1, D], ``past_action`` [E, C - 1, F * A] and ``past_count`` [E]: for a predictor with a history, the
      last latents of real frames, the blocks executed after each, and how many of them are filled.

    Environments without memory, with ``is_init`` true or with an empty queue are planned for; the others are left as they are.
    Where environments reset themselves, append TorchRL's ``InitTracker``, which writes ``is_init``. Otherwise the actions of the
    old episode continue. ``plan_seed`` identifies the random draws of each environment, 0, 1, ... when absent: a plan depends on
    this number and on how many plans came before it in the episode, not on the other environments.

    With ``time_to_go`` in the planner's configuration, the goal of an episode is due after so many blocks: each plan gets the
    blocks that are left, between ``min_time_to_go`` and the horizon. Otherwise a goal is due at the horizon of every plan, and
    a policy that plans again before need not arrive.

    Args:
        planner (LatentPlanner): makes the plans; its world model encodes the frames.

    Raises:
        TypeError: when called with something else than a tensordict.
        ValueError: when called with a tensordict of more than one batch dimension.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ficreg import CEMConfig, LatentCEMPlanner, ModelConfig, MPCPolicy, make_world_model
        >>> model, _ = make_world_model(ModelConfig.preset("cpu"), action_dim=2)
        >>> config = CEMConfig(num_candidates=8, num_elites=2, iterations=1)
        >>> policy = MPCPolicy(LatentCEMPlanner(model.eval(), config, action_bounds=([-1, -1], [1, 1])))
        >>> frame = torch.zeros(2, 3, 64, 64, dtype=torch.uint8)
        >>> policy(TensorDict({"pixels": frame, "goal_pixels": frame}, [2]))["action"].shape
        torch.Size([2, 2])
        >>> policy.set_keys(pixels=("camera", "rgb"), memory=("agent", "mpc"))
        >>> policy.in_keys, policy.out_keys
        ([('camera', 'rgb'), 'goal_pixels'], ['action', ('agent', 'mpc')])
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        pixels: NestedKey = PIXELS
        goal_pixels: NestedKey = GOAL_PIXELS
        action: NestedKey = ACTION
        is_init: NestedKey = IS_INIT
        plan_seed: NestedKey = PLAN_SEED
        memory: NestedKey = MPC_MEMORY

    def __init__(self, planner: LatentPlanner) -> None:
        super().__init__()
        self.planner = planner
        self.set_keys()

    def _apply_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys, self.out_keys = [keys.pixels, keys.goal_pixels], [keys.action, keys.memory]

    @property
    def frame_interval(self) -> int:
        """Environment steps between the frames that are read: a plan's, or a block's for a predictor with a history."""
        blocks = 1 if self.planner.context > 1 else self.planner.config.receding_horizon
        return blocks * self.planner.world_model.frame_skip

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes one raw action per environment, after planning where a plan is due; see the class."""
        require_tensordict("MPCPolicy", tensordict)
        if tensordict.ndim > 1:
            raise ValueError(f"MPCPolicy takes batches [E] or [], got {list(tensordict.shape)}: reshape the environments to [E].")
        keys, td = self.tensor_keys, tensordict if tensordict.ndim else tensordict.unsqueeze(0)
        pixels, memory = td[keys.pixels], self._memory(td)
        plan_due = memory["cursor"] >= memory["queue"].shape[1]  # [E]
        has_history = self.planner.context > 1
        needs_latent = memory["cursor"] % self.planner.world_model.frame_skip == 0 if has_history else plan_due  # [E]
        if needs_latent.any():
            latent = self._encode(pixels, needs_latent)  # [E, D], zeros elsewhere
            if plan_due.any():
                goal, seeds = self._encode(td[keys.goal_pixels], plan_due), self._seeds(td)[plan_due.cpu()]
                memory[plan_due] = self._plan(latent[plan_due], goal[plan_due], memory[plan_due], seeds)
            if has_history:
                memory[needs_latent] = self._remember(latent[needs_latent], memory[needs_latent])
        step = memory["cursor"]  # [E]
        action = memory["queue"][torch.arange(len(step), device=step.device), step].to(pixels.device)  # [E, A]
        memory["cursor"] = step + 1
        if not tensordict.ndim:
            action, memory = action[0], memory[0]
        return tensordict.set(keys.action, action).set(keys.memory, memory)

    def _memory(self, td: TensorDictBase) -> TensorDict:
        """A copy of the memory in which the queue of environments at the start of an episode counts as executed.

        Counts lie on the device of the environments, which read them at every step, all other entries on the model's device.
        """
        config, model, keys = self.planner.config, self.planner.world_model, self.tensor_keys
        actions, envs, past = config.receding_horizon * model.frame_skip, len(td), self.planner.context - 1
        memory = td.get(keys.memory, None)
        if memory is None:
            zeros, like = torch.zeros(envs, dtype=torch.long, device=td.device), model.statistics.mean
            return TensorDict(
                {
                    "queue": like.new_zeros(envs, actions, len(like)),
                    "cursor": zeros + actions,
                    "count": zeros,
                    PLAN: like.new_zeros(envs, config.horizon, model.block_dim),
                    PLAN_COST: like.new_zeros(envs, dtype=torch.float32),  # half precision would round it
                    PAST_LATENT: like.new_zeros(envs, past, model.latent_dim),
                    PAST_ACTION: like.new_zeros(envs, past, model.block_dim),
                    "past_count": zeros.clone(),
                },
                [envs],
            )
        memory = memory.clone()
        is_init = td.get(keys.is_init, None)
        if is_init is not None:
            is_init = is_init.reshape(envs, -1).any(-1)
            memory["cursor"] = memory["cursor"].masked_fill(is_init, actions)
            for count in ("count", "past_count"):
                memory[count] = memory[count].masked_fill(is_init, 0)
        return memory

    def _seeds(self, td: TensorDictBase) -> torch.Tensor:
        """[E] int64, on the CPU."""
        seeds = td.get(self.tensor_keys.plan_seed, None)
        return torch.arange(len(td), device="cpu") if seeds is None else seeds.reshape(len(td)).cpu()

    @torch.no_grad()
    def _encode(self, pixels: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        """Frames [E, 3, H, W] -> latents [E, D] where a mask [E] is true, zeros elsewhere."""
        model = self.planner.world_model
        latent = model.statistics.mean.new_zeros(len(pixels), model.latent_dim)
        latent[where] = model.encode(pixels[where].to(latent.device)).to(latent.dtype)
        return latent

    def _remember(self, latent: torch.Tensor, memory: TensorDict) -> TensorDict:
        """Memory of e environments after their present latents [e, D] and next blocks were added to the past."""
        model, past = self.planner.world_model, memory[PAST_LATENT].shape[1]
        rows = torch.arange(len(latent), device=latent.device).unsqueeze(1)
        steps = memory["cursor"].unsqueeze(1).to(latent.device) + torch.arange(model.frame_skip, device=latent.device)  # [e, F]
        block = model.statistics.normalize(memory["queue"][rows, steps]).flatten(1)  # [e, F * A]
        memory[PAST_LATENT] = torch.cat([memory[PAST_LATENT], latent.unsqueeze(1)], dim=1)[:, 1:]
        memory[PAST_ACTION] = torch.cat([memory[PAST_ACTION], block.unsqueeze(1)], dim=1)[:, 1:]
        memory["past_count"] = (memory["past_count"] + 1).clamp_max(past)
        return memory

    def _plan(self, latent: torch.Tensor, goal: torch.Tensor, memory: TensorDict, seeds: torch.Tensor) -> TensorDict:
        """Memory of e environments after planning from their present latents and goals [e, D]."""
        model, config, device = self.planner.world_model, self.planner.config, latent.device
        mixed = [mix_seeds(seed % 2**63, count) for seed, count in zip(seeds.tolist(), memory["count"].tolist())]
        draws = torch.tensor(mixed, device="cpu")
        initial = self._rest_of_last_plan(memory)  # [e, horizon, F * A]
        time_to_go = self._time_to_go(memory["count"])  # [e], or None
        plan, cost = torch.zeros_like(initial), torch.zeros_like(memory[PLAN_COST])
        for past in memory["past_count"].unique().tolist():  # contexts of one length can be planned from together
            rows = memory["past_count"] == past
            first = memory[PAST_LATENT].shape[1] - past
            context = torch.cat([memory[PAST_LATENT][rows, first:], latent[rows].unsqueeze(1)], dim=1)  # [., C, D]
            past_action = memory[PAST_ACTION][rows, first:]
            timed = {} if time_to_go is None else {"time_to_go": time_to_go[rows]}
            result = self.planner.plan(
                context, goal[rows], draws[rows.cpu()], past_action=past_action, initial=initial[rows], **timed
            )
            plan[rows], cost[rows] = result[PLAN].to(plan.dtype), result[PLAN_COST].to(cost.dtype)
        blocks = plan[:, : config.receding_horizon]  # [e, R, F * A]
        queue = model.statistics.denormalize(blocks.unflatten(-1, (model.frame_skip, -1)).flatten(1, 2))  # [e, R * F, A]
        if self.planner.action_bounds is not None:  # z-scoring and back may round an action out of the bounds
            queue = queue.clamp(*(bound.to(device) for bound in self.planner.action_bounds))
        count, queue = memory["count"] + 1, queue.to(memory["queue"].dtype)
        return memory.update({PLAN: plan, PLAN_COST: cost, "queue": queue, "cursor": torch.zeros_like(count), "count": count})

    def _time_to_go(self, count: torch.Tensor) -> torch.Tensor | None:
        """Blocks until the goal is due [e], after ``count`` [e] plans in the episode; None without ``config.time_to_go``."""
        config = self.planner.config
        if not getattr(config, "time_to_go", 0):
            return None
        left, least = config.time_to_go - count * config.receding_horizon, getattr(config, "min_time_to_go", 1)
        return left.clamp(min(least, config.horizon), config.horizon)

    def _rest_of_last_plan(self, memory: TensorDict) -> torch.Tensor:
        """The blocks of the last plan that were not executed, then mean actions: [e, horizon, F * A]."""
        last, executed = memory[PLAN], self.planner.config.receding_horizon
        rest = torch.cat([last[:, executed:], torch.zeros_like(last[:, :executed])], dim=1)
        has_plan = (memory["count"] > 0)[:, None, None].to(rest.device)
        return torch.where(has_plan, rest, 0.0) if self.planner.config.warm_start else torch.zeros_like(rest)
