"""Bounds of raw actions and of z-scored action blocks, and components that keep one value."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchrl_ficreg.modules.world_model import LatentWorldModel

Bounds = tuple[torch.Tensor, torch.Tensor]


def check_bounds(world_model: LatentWorldModel, bounds: tuple[Sequence[float], Sequence[float]]) -> Bounds:
    """Checks bounds in environment units against the model's action statistics.

    Args:
        world_model (LatentWorldModel): its statistics have A dimensions.
        bounds (tuple): (low [A], high [A]); equal where a component never changes.

    Returns:
        (low [A], high [A]), float32, on the CPU.

    Raises:
        ValueError: another shape, a low above its high, or statistics that no actions between the bounds can have.
    """
    try:
        low, high = (torch.as_tensor(bound, dtype=torch.float32, device="cpu") for bound in bounds)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action_bounds must be (low, high) in environment units, got {bounds!r}.") from error
    mean, std = _mean_and_std(world_model)
    if low.shape != mean.shape or high.shape != mean.shape or not (low <= high).all():
        raise ValueError(
            f"action_bounds must be low <= high of shape {list(mean.shape)} in environment units, got {low.tolist()} and "
            f"{high.tolist()}: was the model trained for another environment?"
        )
    if _are_defaults(mean, std):
        return low, high
    # No distribution between the bounds has a mean outside them or a std above half their distance. A std of 1 marks a
    # component that never changed. Statistics of a model in half precision are rounded.
    eps = max(torch.finfo(world_model.statistics.mean.dtype).eps, torch.finfo(torch.float32).eps)
    rounding, slack = max(1e-3, eps), eps * torch.maximum(low.abs(), high.abs())
    outside = (mean < low - slack) | (mean > high + slack)
    too_wide = (std > (high - low) / 2 * (1 + rounding)) & (std != 1)
    if (outside | too_wide).any():
        raise ValueError(
            f"the model's action statistics (mean {mean.tolist()}, std {std.tolist()}) cannot come from actions "
            f"between {low.tolist()} and {high.tolist()}: was the model trained for another environment?"
        )
    return low, high


def constant_components(world_model: LatentWorldModel, bounds: Bounds | None) -> torch.Tensor:
    """Action components that a search keeps constant, because they never changed in the training data.

    Those that the action statistics mark, those whose bounds are equal, and those whose std of 1, which marks a component
    that never changed, is larger than that of any actions between the bounds with their mean.

    Args:
        world_model (LatentWorldModel): its statistics have A dimensions.
        bounds (tuple, optional): (low [A], high [A]) as returned by :func:`check_bounds`.

    Returns:
        [A] bool, on the CPU.
    """
    mean, std = _mean_and_std(world_model)
    constant = world_model.statistics.constant.cpu()
    if bounds is None:
        return constant
    low, high = bounds
    constant = constant | (low == high)
    if _are_defaults(mean, std):
        return constant
    return constant | ((std == 1) & (1 > (high - mean).clamp_min(0) * (mean - low).clamp_min(0) * 1.002))


def block_bounds(world_model: LatentWorldModel, bounds: Bounds | None) -> Bounds | None:
    """Bounds of a z-scored action block; low and high are equal for constant components.

    Args:
        world_model (LatentWorldModel): its statistics have A dimensions.
        bounds (tuple, optional): (low [A], high [A]) in environment units as returned by :func:`check_bounds`.

    Returns:
        (low [F * A], high [F * A]) on the model's device, in float32 or float64; None where nothing is bounded.
    """
    constant = constant_components(world_model, bounds)
    if bounds is None and not constant.any():
        return None
    statistics, repeat = world_model.statistics, world_model.frame_skip
    kind = {"device": statistics.mean.device, "dtype": torch.promote_types(statistics.mean.dtype, torch.float32)}
    if bounds is None:
        high = torch.full(constant.shape, torch.inf, **kind)
        low = -high
    else:
        low, high = (statistics.normalize(bound.to(**kind)) for bound in bounds)
    value = torch.zeros_like(low).clamp(low, high)  # z = 0 is the value of a constant component in the data
    constant = constant.to(low.device)
    return tuple(torch.where(constant, value, bound).repeat(repeat) for bound in (low, high))


def _mean_and_std(world_model: LatentWorldModel) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and std [A] of raw actions, float32, on the CPU."""
    statistics = world_model.statistics
    return statistics.mean.float().cpu(), statistics.std.float().cpu()


def _are_defaults(mean: torch.Tensor, std: torch.Tensor) -> bool:
    """Whether these are the zeros and ones of a model without statistics, which carry no information on the actions."""
    return bool((mean == 0).all() and (std == 1).all())
