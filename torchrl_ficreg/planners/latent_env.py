"""The world model as a TorchRL environment, on which TorchRL's own planners plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_ficreg.keys import ACTION, GOAL_LATENT, LATENT, PAST_ACTION, PAST_LATENT, PAST_LENGTH
from torchrl_ficreg.modules.keyed import KeyedMixin
from torchrl_ficreg.modules.world_model import LatentWorldModel
from torchrl_ficreg.planners.bounds import block_bounds, check_bounds

_REWARDS = ("progress", "distance")


class LatentGoalEnv(KeyedMixin, ModelBasedEnvBase):
    r"""Imagined environment: one action block per step, a reward for coming closer to a goal in latent space.

    It takes tensordicts of any batch size, as TorchRL's planners (:class:`~torchrl.modules.planners.CEMPlanner`,
    :class:`~torchrl.modules.planners.MPPIPlanner`) require. With d the squared distance to the goal latent g, the reward of
    the step from :math:`z_t` to :math:`z_{t+1}` is

    * ``"progress"``: :math:`d(z_t, g) - d(z_{t+1}, g)`. The sum, which those planners maximise, is
      :math:`d(z_0, g) - d(z_T, g)`: the published terminal cost (arXiv 2603.19312) up to a constant;
    * ``"distance"``: :math:`-d(z_{t+1}, g)`. The sum is the negative distance over the whole path.

    Those planners execute the first block and plan again. Shorten ``planning_horizon`` with every step left, or choose
    ``"distance"``: with a constant horizon, ``"progress"`` does not reward an early arrival. :class:`~torchrl_ficreg.MPCPolicy`
    counts down a time-to-go.

    Start with ``reset(tensordict)``, where the tensordict has ``latent`` and ``goal_latent`` [..., D]; it writes the other
    entries. All five are observations, because TorchRL passes only observations on to the next step:

    ===============  ====================  ===========================================================
    ``latent``       [..., D]              imagined now
    ``goal_latent``  [..., D]              constant
    ``past_latent``  [..., H - 1, D]       those before it, oldest first; the last ``past_length`` count
    ``past_action``  [..., H - 1, F * A]   the z-scored blocks executed after them
    ``past_length``  [..., 1] int64        how many: 0 after a reset, at most H - 1
    ===============  ====================  ===========================================================

    The predictor gets the same window as in :meth:`~torchrl_ficreg.LatentWorldModel.rollout`: it grows from one latent to H
    and then slides, without the zeros before the start. ``action`` [..., F * A] is a z-scored block, ``reward`` is [..., 1],
    ``done`` is always false. No gradient flows through a step. All keys can be changed with :meth:`set_keys`.

    With TorchRL's planners, every plan starts from mean 0 and standard deviation 1; ``CEMPlanner`` needs ``top_k`` of at least
    2; on a GPU the tensordict must have a device; the key of the action must be ``action``. ``MPPIPlanner`` weights candidates by ``exp(temperature * advantage)``. The
    advantage is the sum of rewards here, as there is no value function beyond the horizon. The example measures it relative to
    the best candidate, so that no weight overflows, and in standard deviations, so that ``temperature`` does not depend on the
    scale of the latents.

    Args:
        world_model (LatentWorldModel): the dynamics, in ``eval()`` mode and with its action statistics. It stays on its device.
        reward (str, optional): ``"progress"`` or ``"distance"``. Default: ``"progress"``.
        action_bounds (tuple, optional): (low [A], high [A]) in environment units. Default: unbounded.

    Raises:
        ValueError: an unknown reward, or bounds of another shape than the model's actions. On reset: latents of
            another shape or not finite, or a world model in train mode. On a step: a block of another width.
        KeyError: a reset without ``latent`` and ``goal_latent``, or a step without a reset.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules.planners import CEMPlanner, MPPIPlanner
        >>> from torchrl_ficreg import LatentGoalEnv, make_world_model, ModelConfig
        >>> model, _ = make_world_model(ModelConfig.preset("cpu", latent_dim=4), action_dim=2)
        >>> env = LatentGoalEnv(model.eval(), action_bounds=([-1, -1], [1, 1]))
        >>> start = TensorDict({"latent": torch.zeros(7, 4), "goal_latent": torch.ones(7, 4)}, [7])
        >>> planner = CEMPlanner(env, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4)
        >>> planner(env.reset(start))["action"].shape
        torch.Size([7, 10])

        >>> def behind_best(reward):  # [..., K, T, 1]
        ...     total = reward.sum(-2, keepdim=True)  # [..., K, 1, 1]
        ...     std = total.std(-3, keepdim=True).clamp_min(1e-6)
        ...     return ((total - total.amax(-3, keepdim=True)) / std).expand_as(reward)
        >>> advantage = TensorDictModule(behind_best, [("next", "reward")], ["advantage"])
        >>> planner = MPPIPlanner(
        ...     env, advantage, temperature=1.0, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4
        ... )
        >>> planner(env.reset(start))["action"].shape
        torch.Size([7, 10])
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        latent: NestedKey = LATENT
        goal_latent: NestedKey = GOAL_LATENT
        past_latent: NestedKey = PAST_LATENT
        past_action: NestedKey = PAST_ACTION
        past_length: NestedKey = PAST_LENGTH
        action: NestedKey = ACTION
        reward: NestedKey = "reward"

    def __init__(
        self,
        world_model: LatentWorldModel,
        *,
        reward: Literal["progress", "distance"] = "progress",
        action_bounds: tuple[Sequence[float], Sequence[float]] | None = None,
    ) -> None:
        if reward not in _REWARDS:
            raise ValueError(f"unknown reward {reward!r}: choose one of {', '.join(map(repr, _REWARDS))}.")
        super().__init__(world_model, device=world_model.statistics.mean.device)
        self._rewards_progress = reward == "progress"
        self._block_bounds = None
        if action_bounds is not None:
            self._block_bounds = block_bounds(world_model, check_bounds(world_model, action_bounds))
        self.set_keys()

    def _apply_keys(self) -> None:
        """Names the specs."""
        keys, model = self.tensor_keys, self.world_model
        latent_dim, block_dim, past, mean = model.latent_dim, model.block_dim, model.history - 1, model.statistics.mean
        kind = {"device": mean.device, "dtype": mean.dtype}
        self.observation_spec = Composite(
            {
                keys.latent: Unbounded((latent_dim,), **kind),
                keys.goal_latent: Unbounded((latent_dim,), **kind),
                keys.past_latent: Unbounded((past, latent_dim), **kind),
                keys.past_action: Unbounded((past, block_dim), **kind),
                keys.past_length: Bounded(0, past, (1,), device=mean.device, dtype=torch.int64),
            },
            device=mean.device,
        )
        self.state_spec = self.observation_spec.clone()
        bounds = self._block_bounds
        action = Unbounded((block_dim,), **kind) if bounds is None else Bounded(*bounds, **kind)
        self.action_spec = Composite({keys.action: action}, device=mean.device)
        self.reward_spec = Composite({keys.reward: Unbounded((1,), **kind)}, device=mean.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        keys = self.tensor_keys
        start = {key: None if tensordict is None else tensordict.get(key, None) for key in (keys.latent, keys.goal_latent)}
        missing = [key for key, value in start.items() if value is None]
        if missing:
            raise KeyError(
                f"an imagined episode starts from {keys.latent!r} and {keys.goal_latent!r}, {missing} missing: encode a frame and "
                "a goal frame with world_model.encode and call env.reset(tensordict), or env.rollout(tensordict=...)."
            )
        if any(module.training for module in self.world_model.children()):
            raise ValueError("the world model is in train mode, where dropout blurs every step: call its eval().")
        specs, lead = self.observation_spec, tensordict.batch_size
        width = specs[keys.latent].shape[-1]
        start = {key: value.to(self.device, specs[key].dtype) for key, value in start.items()}
        for key, value in start.items():
            if value.shape != (*lead, width):
                raise ValueError(
                    f"{key!r} must be {[*lead, width]} in a tensordict of batch size {list(lead)}, got "
                    f"{list(value.shape)}: encode it with this world model, and give the tensordict its batch size."
                )
            if not value.isfinite().all():
                raise ValueError(f"{key!r} holds a NaN or an infinity: check the frames it was encoded from.")
        past = {key: specs[key].zero(lead) for key in (keys.past_latent, keys.past_action, keys.past_length)}
        return TensorDict({**start, **past}, lead, device=self.device)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        keys = self.tensor_keys
        past_length = tensordict.get(keys.past_length, None)
        if past_length is None:
            raise KeyError(f"{keys.past_length!r} is missing: give the tensordict to env.reset before stepping or planning.")
        latent, goal, action = (tensordict.get(key) for key in (keys.latent, keys.goal_latent, keys.action))
        past_action = tensordict.get(keys.past_action)
        if action.shape != (*tensordict.batch_size, past_action.shape[-1]):
            raise ValueError(
                f"{keys.action!r} must be one z-scored block {[*tensordict.batch_size, past_action.shape[-1]]} (frame skip x "
                f"raw action dimension), got {list(action.shape)}."
            )
        window = torch.cat([tensordict.get(keys.past_latent), latent.unsqueeze(-2)], dim=-2)  # [..., H, D]
        blocks = torch.cat([past_action, action.unsqueeze(-2)], dim=-2)  # [..., H, F * A]
        following = self._imagine(window, blocks, past_length.squeeze(-1))  # [..., D]
        reward = -_squared_distance(following, goal)  # [..., 1]
        if self._rewards_progress:
            reward = reward + _squared_distance(latent, goal)
        return TensorDict(
            {
                keys.latent: following,
                keys.goal_latent: goal,
                keys.past_latent: window[..., 1:, :],
                keys.past_action: blocks[..., 1:, :],
                keys.past_length: (past_length + 1).clamp(max=past_action.shape[-2]),
                keys.reward: reward,
            },
            tensordict.batch_size,
            device=tensordict.device,
        )

    def _imagine(self, window: torch.Tensor, blocks: torch.Tensor, past: torch.Tensor) -> torch.Tensor:
        """Next latents [..., D] of windows [..., H, D] and [..., H, F * A] whose last ``past + 1`` rows are filled.

        Rows that were reset at different times have windows of different lengths: there is one rollout for each length.
        """
        following = torch.empty_like(window[..., 0, :])  # [..., D]
        for length in past.unique().tolist() if window.shape[-2] > 1 else [0]:
            rows = past == length  # [...]
            filled = slice(-1 - length, None)
            following[rows] = self.world_model.rollout(window[rows][:, filled], blocks[rows][:, filled])[:, 0]
        return following


def _squared_distance(latent: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """[..., D] and [..., D] -> [..., 1]."""
    return (latent - goal).square().sum(-1, keepdim=True)
