"""Checks of the tensors that a plan starts from."""

from __future__ import annotations

from typing import NamedTuple

import torch

from torchrl_ficreg.modules.world_model import LatentWorldModel


class PlanInputs(NamedTuple):
    """Inputs of a plan for E environments.

    Attributes:
        latent: context [E, C, D], oldest frame first.
        past_action: z-scored blocks executed between the frames of the context [E, C - 1, F * A].
        goal: [E, D].
        initial: z-scored mean of the first iteration [E, horizon, F * A].
        time_to_go: blocks until the goal is due [E] int64, from 1 to the horizon.
        seeds: E names of random draws.
    """

    latent: torch.Tensor
    past_action: torch.Tensor
    goal: torch.Tensor
    initial: torch.Tensor
    time_to_go: torch.Tensor
    seeds: list[int]

    def to(self, dtype: torch.dtype) -> PlanInputs:
        """The same with all floating-point tensors in another dtype."""
        return PlanInputs(*(tensor.to(dtype) for tensor in self[:4]), self.time_to_go, self.seeds)

    def clone(self) -> PlanInputs:
        """The same with copies of all tensors."""
        return PlanInputs(*(tensor.clone() for tensor in self[:5]), self.seeds)

    def split(self, size: int) -> list[PlanInputs]:
        """Groups of at most ``size`` environments."""
        return [PlanInputs(*(value[i : i + size] for value in self)) for i in range(0, len(self.seeds), size)]


def check_inputs(
    world_model: LatentWorldModel,
    horizon: int,
    latent: torch.Tensor,
    goal: torch.Tensor,
    seeds: torch.Tensor | None = None,
    past_action: torch.Tensor | None = None,
    initial: torch.Tensor | None = None,
    time_to_go: torch.Tensor | None = None,
) -> PlanInputs:
    """Fills in what was left out and checks the rest; see :meth:`~torchrl_ficreg.LatentPlanner.plan` for the arguments.

    Raises:
        ValueError: other shapes, numbers that are not finite, or a world model in train mode.
    """
    if any(module.training for module in world_model.children()):
        raise ValueError("the world model is in train mode, where dropout blurs every plan: call its eval().")
    envs, width, block = len(latent), world_model.latent_dim, world_model.block_dim
    if latent.ndim == 2:
        latent = latent.unsqueeze(1)  # [E, 1, D]
    if past_action is None and latent.ndim == 3 and latent.shape[1] == 1:
        past_action = latent.new_zeros(envs, 0, block)
    if initial is None:
        initial = latent.new_zeros(envs, horizon, block)
    if time_to_go is None:
        time_to_go = torch.full((envs,), horizon, device=latent.device)
    time_to_go = torch.as_tensor(time_to_go, device=latent.device)
    seeds = list(range(envs)) if seeds is None else torch.as_tensor(seeds, device="cpu").long().flatten().tolist()
    if (
        latent.ndim != 3
        or envs < 1
        or latent.shape[-1] != width
        or goal.shape != (envs, width)
        or len(seeds) != envs
        or initial.shape != (envs, horizon, block)
    ):
        raise ValueError(
            f"expected latents [E, {width}] or [E, C, {width}], goals [E, {width}], seeds [E] and initial plans "
            f"[E, {horizon}, {block}], got {list(latent.shape)}, {list(goal.shape)}, [{len(seeds)}] and "
            f"{list(initial.shape)}."
        )
    if past_action is None or past_action.shape != (envs, latent.shape[1] - 1, block):
        raise ValueError(
            f"a context of {latent.shape[1]} frames needs past_action [{envs}, {latent.shape[1] - 1}, {block}], the "
            f"z-scored blocks executed between them, got {None if past_action is None else list(past_action.shape)}."
        )
    whole = not time_to_go.is_floating_point()
    if time_to_go.shape != (envs,) or not (whole and ((1 <= time_to_go) & (time_to_go <= horizon)).all()):
        raise ValueError(f"time_to_go must be [{envs}] numbers of blocks from 1 to horizon={horizon}, got {time_to_go.tolist()}.")
    for name, value in (("latents", latent), ("goals", goal), ("past actions", past_action), ("initial plans", initial)):
        if not value.isfinite().all():
            raise ValueError(f"there are {name} that are not finite: did training diverge, or is a frame damaged?")
    return PlanInputs(latent, past_action, goal, initial, time_to_go.long(), seeds)
