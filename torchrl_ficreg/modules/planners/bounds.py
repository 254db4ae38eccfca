"""Bounds of a raw action, and of a z-scored action block."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchrl_ficreg.modules.world_model import LatentWorldModel

Bounds = tuple[torch.Tensor, torch.Tensor]


def check_bounds(world_model: LatentWorldModel, bounds: tuple[Sequence[float], Sequence[float]]) -> Bounds:
    """Bounds in environment units that the model's action statistics can come from.

    Args:
        world_model: its statistics have A dimensions.
        bounds: (low [A], high [A]).

    Returns:
        (low [A], high [A]), float32, on the CPU.

    Raises:
        ValueError: another shape, a low that is not below its high, or statistics that no actions in between have.
    """
    try:
        low, high = (torch.as_tensor(bound, dtype=torch.float32).cpu() for bound in bounds)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action_bounds must be (low, high) in environment units, got {bounds!r}.") from error
    shape = world_model.action_mean.shape
    if low.shape != shape or high.shape != shape or not (low < high).all():
        raise ValueError(
            f"action_bounds must be low < high of shape {list(shape)} in environment units, got {low.tolist()} and "
            f"{high.tolist()}: was the model trained for another environment?"
        )
    mean, std = world_model.action_mean.float().cpu(), world_model.action_std.float().cpu()
    # No distribution inside the bounds has a mean outside them or a std above half their distance.
    if ((mean < low) | (mean > high) | (std > (high - low) / 2 * 1.001)).any() and (std != 1).any():
        raise ValueError(
            f"the model's action statistics (mean {mean.tolist()}, std {std.tolist()}) cannot come from actions "
            f"between {low.tolist()} and {high.tolist()}: was the model trained for another environment?"
        )
    return low, high


def block_bounds(world_model: LatentWorldModel, bounds: Bounds) -> Bounds:
    """Raw bounds (low [A], high [A]) -> those of a z-scored action block, (low [F * A], high [F * A])."""
    statistics, repeat = world_model.statistics, world_model.frame_skip
    return tuple(statistics.normalize(bound.to(statistics.mean)).repeat(repeat) for bound in bounds)
