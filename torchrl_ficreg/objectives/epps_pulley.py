"""The Epps-Pulley statistic with a gradient of its own: small in memory, and right on several processes.

All knots are multiples of the first, so with z = exp(i angle) the characteristic function at knot k is the mean of
z^k: one complex product per knot, instead of a sine and a cosine. The gradient is a polynomial in the same z, by
Horner's rule. Only z is kept for the backward pass, not one pair for every knot.
"""

from __future__ import annotations

import torch
import torch.distributed as dist

from torchrl_ficreg.modules.collectives import num_processes, sum_over_processes


def epps_pulley(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Statistic of projections against N(0, 1), over the batches of all processes together.

    Args:
        angle: [T, B, M], projections times the first knot.
        mask: [T, B] bool, or None; false samples are left out.
        gaussian: [K], characteristic function of N(0, 1) at the knots.
        weight: [K], quadrature weights.

    Returns:
        [T, M], B times the weighted squared distance; differentiable in ``angle``, once.
    """
    if torch._C._are_functorch_transforms_active():  # torch.func cannot differentiate an operator that is not torch's own
        return _plainly(angle, mask, gaussian, weight)
    return _epps_pulley(angle, mask, gaussian, weight)[0]


def _plainly(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """As :func:`epps_pulley`, by torch's own operators: all knots at once, in K times the memory."""
    order = torch.arange(1, len(weight) + 1, device=angle.device, dtype=angle.dtype).view(-1, 1, 1, 1)
    phase = order * angle  # [K, T, B, M]
    parts = torch.stack([phase.cos(), phase.sin()])  # [2, K, T, B, M]
    parts = parts if mask is None else torch.where(mask.unsqueeze(-1), parts, 0.0)
    count = sum_over_processes(_counts(angle, mask))  # [T]
    cos, sin = sum_over_processes(parts.sum(-2)) / count.clamp_min(1).unsqueeze(-1)  # each [K, T, M]
    distance = (cos - gaussian.view(-1, 1, 1)).square() + sin.square()
    return count.unsqueeze(-1) * torch.einsum("ktm,k->tm", distance, weight)


# An operator of its own: torch.compile takes it as it is, instead of tracing complex arithmetic it cannot generate.
@torch.library.custom_op("torchrl_ficreg::epps_pulley", mutates_args=())
def _epps_pulley(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Statistic [T, M], z [T, B, M] complex, deviation from the Gaussian [K, T, M] complex."""
    angle = angle.contiguous()  # a compiler lays inputs out as it likes, and is promised contiguous results
    unit = torch.polar(torch.ones_like(angle), angle)  # [T, B, M]
    if mask is not None:
        unit = torch.where(mask.unsqueeze(-1), unit, 0.0).contiguous()  # powers of zero add nothing to a sum
    total = unit.new_empty(len(gaussian), angle.shape[0], angle.shape[2])  # [K, T, M]
    for time, base in enumerate(unit):  # one time step at a time stays in the cache
        power = base.clone()  # [B, M]
        for knot in range(len(gaussian)):
            if knot:
                power.mul_(base)
            torch.sum(power, 0, out=total[knot, time])
    count = _counts(angle, mask)
    if num_processes() > 1:
        dist.all_reduce(torch.view_as_real(total))
        dist.all_reduce(count)
    deviation = total / count.clamp_min(1).unsqueeze(-1) - gaussian.view(-1, 1, 1)  # [K, T, M]
    distance = torch.einsum("ktm,k->tm", torch.view_as_real(deviation).square().sum(-1), weight)
    return count.unsqueeze(-1) * distance, unit, deviation


@_epps_pulley.register_fake
def _(angle, mask, gaussian, weight):
    kind = torch.complex128 if angle.dtype == torch.float64 else torch.complex64
    knots, (times, _, directions) = len(gaussian), angle.shape
    return (
        angle.new_empty(times, directions),
        angle.new_empty(angle.shape, dtype=kind),
        angle.new_empty((knots, times, directions), dtype=kind),
    )


@torch.library.custom_op("torchrl_ficreg::epps_pulley_backward", mutates_args=())
def _epps_pulley_backward(
    grad: torch.Tensor, unit: torch.Tensor, deviation: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Gradient [T, B, M] of the angles from that of the statistic [T, M].

    d/d(angle) = 2 sum_k weight_k k Re(conj(deviation_k) i z^k), the factor B having cancelled the 1/B of the mean.
    """
    grad = grad.clone()
    if num_processes() > 1:
        dist.all_reduce(grad)
    order = torch.arange(1, len(weight) + 1, device=weight.device, dtype=weight.dtype)
    slope = (2 * order * weight).view(-1, 1, 1) * grad  # [K, T, M]
    coefficient = slope * deviation.conj() * 1j  # [K, T, M]
    result = torch.empty(unit.shape, dtype=grad.dtype, device=grad.device)
    for time, base in enumerate(unit):
        total = coefficient[-1, time].expand_as(base).clone()  # [B, M]
        for knot in range(len(weight) - 2, -1, -1):
            total.mul_(base).add_(coefficient[knot, time])
        result[time] = torch.view_as_real(total.mul_(base))[..., 0]
    return result


@_epps_pulley_backward.register_fake
def _(grad, unit, deviation, weight):
    return grad.new_empty(unit.shape)


def _save(ctx, inputs, output) -> None:
    _, unit, deviation = output
    ctx.save_for_backward(unit, deviation, inputs[3])
    ctx.mark_non_differentiable(unit, deviation)


def _differentiate(ctx, grad, *_):
    return _epps_pulley_backward(grad.contiguous(), *ctx.saved_tensors), None, None, None


_epps_pulley.register_autograd(_differentiate, setup_context=_save)


def _counts(angle: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Samples of each time step, [T]."""
    if mask is not None:
        return mask.sum(1).to(angle.dtype)
    return angle.new_full((angle.shape[0],), angle.shape[1])
