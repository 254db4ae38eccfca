"""The world model as a TorchRL environment, so that TorchRL's own planners plan on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.planners.bounds import block_bounds, check_bounds

PAST_LATENT, PAST_ACTION, PAST_LENGTH = "past_latent", "past_action", "past_length"
_REWARDS = ("progress", "distance")


class LatentGoalEnv(ModelBasedEnvBase):
    r"""Imagined environment: one action block per step, rewarded for coming closer to a goal in latent space.

    It takes tensordicts of any batch size, as TorchRL's planners (:class:`~torchrl.modules.planners.CEMPlanner`,
    :class:`~torchrl.modules.planners.MPPIPlanner`) ask. With d the squared distance to the goal latent g, the step
    from :math:`z_t` to :math:`z_{t+1}` is rewarded

    * ``"progress"``: :math:`d(z_t, g) - d(z_{t+1}, g)`. The sum, which those planners maximise, is
      :math:`d(z_0, g) - d(z_T, g)`: the published terminal cost (arXiv 2603.19312) up to a constant;
    * ``"distance"``: :math:`-d(z_{t+1}, g)`. The sum is the distance of the whole path.

    Those planners execute the first block and plan anew. Shorten ``planning_horizon`` with every step left, or choose
    ``"distance"``: over a horizon that never comes closer, ``"progress"`` has no reason to arrive now.

    Start from ``reset(tensordict)`` with ``latent`` and ``goal_latent`` [..., D]; it writes the rest into the
    tensordict. All five are observations, because TorchRL hands nothing else on to the next step:

    ===============  ====================  ===========================================================
    ``latent``       [..., D]              imagined now
    ``goal_latent``  [..., D]              never changes
    ``past_latent``  [..., H - 1, D]       those before it, oldest first; the last ``past_length`` count
    ``past_action``  [..., H - 1, F * A]   the z-scored blocks that led on from them
    ``past_length``  [..., 1] int64        how many: 0 after a reset, at most H - 1
    ===============  ====================  ===========================================================

    So the predictor sees what :meth:`~torchrl_ficreg.LatentWorldModel.rollout` shows it: a window that grows from one
    latent to H and then slides, never the zeros before it. ``action`` [..., F * A] is a z-scored block, ``reward`` is
    [..., 1], ``done`` is always false. No gradient flows through a step.

    What else to know of them: every plan starts from mean 0 and standard deviation 1; ``CEMPlanner`` needs ``top_k``
    of at least 2; on a GPU the tensordict must carry its device. The advantage that ``MPPIPlanner`` weighs by
    ``exp(temperature * advantage)`` is the sum of rewards here, as no value lies beyond the horizon; the example
    measures it from the best candidate, so that no weight overflows, and in standard deviations, so that
    ``temperature`` does not depend on the scale of the latents.

    Args:
        world_model: the dynamics, in ``eval()``, with the statistics it will be used with. It stays on its device.
        reward: ``"progress"`` or ``"distance"``.
        action_bounds: (low [A], high [A]) in environment units; blocks are unbounded when None.

    Raises:
        ValueError: an unknown reward, or bounds of another shape than the model's actions. On reset: latents of
            another shape or not finite, or a world model in train mode. On a step: a block of another width.
        KeyError: a reset without ``latent`` and ``goal_latent``, or a step without a reset.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules.planners import CEMPlanner, MPPIPlanner
        >>> from torchrl_ficreg import make_world_model, ModelConfig
        >>> from torchrl_ficreg.planners.latent_env import LatentGoalEnv
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> env = LatentGoalEnv(model.eval(), action_bounds=([-1, -1], [1, 1]))
        >>> start = TensorDict({"latent": torch.zeros(7, 4), "goal_latent": torch.ones(7, 4)}, [7])
        >>> planner = CEMPlanner(env, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4)
        >>> planner(env.reset(start))["action"].shape
        torch.Size([7, 10])

        >>> def behind_best(reward):  # [..., K, T, 1]
        ...     total = reward.sum(-2, keepdim=True)  # [..., K, 1, 1]
        ...     spread = total.std(-3, keepdim=True).clamp_min(1e-6)
        ...     return ((total - total.amax(-3, keepdim=True)) / spread).expand_as(reward)
        >>> advantage = TensorDictModule(behind_best, [("next", "reward")], ["advantage"])
        >>> planner = MPPIPlanner(
        ...     env, advantage, temperature=1.0, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4
        ... )
        >>> planner(env.reset(start))["action"].shape
        torch.Size([7, 10])
    """

    def __init__(
        self,
        world_model: LatentWorldModel,
        *,
        reward: Literal["progress", "distance"] = "progress",
        action_bounds: tuple[Sequence[float], Sequence[float]] | None = None,
    ) -> None:
        if reward not in _REWARDS:
            raise ValueError(f"unknown reward {reward!r}: choose one of {', '.join(map(repr, _REWARDS))}.")
        super().__init__(world_model, device=world_model.action_mean.device)
        self._rewards_progress = reward == "progress"
        latent_dim, block_dim, past = world_model.latent_dim, world_model.block_dim, world_model.history - 1
        kind = {"device": world_model.action_mean.device, "dtype": world_model.action_mean.dtype}
        self.observation_spec = Composite(
            {
                LATENT: Unbounded((latent_dim,), **kind),
                GOAL_LATENT: Unbounded((latent_dim,), **kind),
                PAST_LATENT: Unbounded((past, latent_dim), **kind),
                PAST_ACTION: Unbounded((past, block_dim), **kind),
                PAST_LENGTH: Bounded(0, past, (1,), device=kind["device"], dtype=torch.int64),
            }
        )
        self.state_spec = self.observation_spec.clone()
        if action_bounds is None:
            self.action_spec = Unbounded((block_dim,), **kind)
        else:
            self.action_spec = Bounded(*block_bounds(world_model, check_bounds(world_model, action_bounds)), **kind)
        self.reward_spec = Unbounded((1,), **kind)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        missing = [key for key in (LATENT, GOAL_LATENT) if tensordict is None or key not in tensordict.keys()]
        if missing:
            raise KeyError(
                f"an imagined episode starts from 'latent' and 'goal_latent', {missing} missing: encode a frame and a "
                "goal frame with world_model.encode and call env.reset(tensordict), or env.rollout(tensordict=...)."
            )
        if self.world_model.encoder.training or self.world_model.predictor.training:
            raise ValueError("the world model is in train mode, where dropout blurs every step: call its eval().")
        specs, lead = self.observation_spec, tensordict.batch_size
        width = specs[LATENT].shape[-1]
        start = {key: tensordict.get(key).to(self.device, specs[key].dtype) for key in (LATENT, GOAL_LATENT)}
        for key, value in start.items():
            if value.shape != (*lead, width):
                raise ValueError(
                    f"{key!r} must be {[*lead, width]} in a tensordict of batch size {list(lead)}, got "
                    f"{list(value.shape)}: encode it with this world model, and give the tensordict its batch size."
                )
            if not value.isfinite().all():
                raise ValueError(f"{key!r} holds a NaN or an infinity: check the frames it was encoded from.")
        past = {key: specs[key].zero(lead) for key in (PAST_LATENT, PAST_ACTION, PAST_LENGTH)}
        return TensorDict({**start, **past}, lead, device=self.device)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if PAST_LENGTH not in tensordict.keys():
            raise KeyError(f"{PAST_LENGTH!r} is missing: give the tensordict to env.reset before stepping or planning.")
        latent, goal, action = (tensordict.get(key) for key in (LATENT, GOAL_LATENT, ACTION))
        past_action, past_length = tensordict.get(PAST_ACTION), tensordict.get(PAST_LENGTH)
        if action.shape != (*tensordict.batch_size, past_action.shape[-1]):
            raise ValueError(
                f"'action' must be one z-scored block {[*tensordict.batch_size, past_action.shape[-1]]} (frame skip x "
                f"raw action dimension), got {list(action.shape)}."
            )
        window = torch.cat([tensordict.get(PAST_LATENT), latent.unsqueeze(-2)], dim=-2)  # [..., H, D]
        blocks = torch.cat([past_action, action.unsqueeze(-2)], dim=-2)  # [..., H, F * A]
        following = self._imagine(window, blocks, past_length.squeeze(-1))  # [..., D]
        reward = -_squared_distance(following, goal)  # [..., 1]
        if self._rewards_progress:
            reward = reward + _squared_distance(latent, goal)
        return TensorDict(
            {
                LATENT: following,
                GOAL_LATENT: goal,
                PAST_LATENT: window[..., 1:, :],
                PAST_ACTION: blocks[..., 1:, :],
                PAST_LENGTH: (past_length + 1).clamp(max=past_action.shape[-2]),
                "reward": reward,
            },
            tensordict.batch_size,
            device=tensordict.device,
        )

    def _imagine(self, window: torch.Tensor, blocks: torch.Tensor, past: torch.Tensor) -> torch.Tensor:
        """Next latents [..., D] of windows [..., H, D] and [..., H, F * A] whose last ``past + 1`` rows are filled.

        Rows that started at different times have windows of different lengths: each length is one rollout.
        """
        following = torch.empty_like(window[..., 0, :])  # [..., D]
        for length in past.unique().tolist() if window.shape[-2] > 1 else [0]:
            rows = past == length  # [...]
            seen = slice(-1 - length, None)
            following[rows] = self.world_model.rollout(window[rows][:, seen], blocks[rows][:, seen])[:, 0]
        return following


def _squared_distance(latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """[..., D] and [..., D] -> [..., 1]."""
    return (latent - goal).square().sum(-1, keepdim=True)
