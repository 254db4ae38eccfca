"""Sketched isotropic Gaussian regularisation."""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.distributed as dist
from torch import nn

from torchrl_ficreg._device import without_autocast
from torchrl_ficreg.distributed import num_processes, sum_over_processes


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


class SIGReg(nn.Module):
    r"""Distance of a batch of latents from an isotropic Gaussian, seen along random directions (arXiv 2511.08544).

    Along each of M random unit vectors the empirical characteristic function of the B projections is compared with
    that of N(0, 1) (Epps-Pulley test):

    .. math:: B \int_{-t_{max}}^{t_{max}} |\hat\varphi(t) - e^{-t^2/2}|^2 \, e^{-t^2/2} dt

    by the trapezoidal rule, then averaged over directions and time steps. The value on N(0, I) is about 1.05 at any
    batch size; collapse to a point at zero gives 0.402 B. Because of the factor B a weight belongs to a batch size.

    Directions are drawn anew at every call in train mode, from a generator of the module's own: its state is a buffer,
    so it travels with checkpoints, and neither the global random state nor the device takes part. In eval mode the
    next directions are looked at without being used up.

    On several processes (``torch.distributed`` initialised) all ranks draw the same directions and the statistic is
    that of the global batch. Its gradient follows the convention of distributed data parallel training: averaged over
    ranks, parameter gradients are those of one process on the whole batch.

    Args:
        num_directions: M.
        num_knots: knots on [0, t_max].
        max_knot: t_max.
        unit: what one sample is: ``"time"`` tests every time step of a [T, B, D] batch on its own, as published,
            ``"batch_time"`` all T x B latents together.
        seed: of the directions.

    Raises:
        ValueError: an argument out of range, or latents that are not [T, B, D] or [B, D] with B >= 2.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> round(SIGReg()(torch.randn(4, 128, 192)).item(), 1)
        1.1
    """

    def __init__(
        self,
        num_directions: int = 1024,
        num_knots: int = 17,
        max_knot: float = 3.0,
        *,
        unit: Literal["time", "batch_time"] = "time",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if num_directions < 1 or num_knots < 2 or not 0 < max_knot < math.inf:
            raise ValueError(
                "SIGReg needs num_directions >= 1, num_knots >= 2 and max_knot > 0, "
                f"got {num_directions}, {num_knots} and {max_knot}."
            )
        if unit not in ("time", "batch_time"):
            raise ValueError(f"unknown unit {unit!r}: choose 'time' or 'batch_time'.")
        self.num_directions, self.num_knots, self.max_knot, self.unit = num_directions, num_knots, max_knot, unit
        self.register_buffer("generator_state", torch.tensor([seed, 0]))  # seed, number of draws

    def forward(self, latent: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Latents [T, B, D], or [B, D] -> the statistic [], at least float32 inside any autocast.

        Args:
            latent: [T, B, D] or [B, D].
            mask: [T, B] or [B] bool; false latents are left out, whatever they hold.
        """
        if latent.ndim not in (2, 3) or latent.shape[-2] < 2:
            raise ValueError(f"SIGReg takes latents [T, B, D] or [B, D] with B >= 2, got {list(latent.shape)}.")
        if mask is not None and (mask.shape != latent.shape[:-1] or mask.dtype != torch.bool):
            raise ValueError(f"the mask must be {list(latent.shape[:-1])} bool, got {list(mask.shape)} {mask.dtype}.")
        lead = (1, -1) if latent.ndim == 2 or self.unit == "batch_time" else latent.shape[:2]
        mask = None if mask is None else mask.reshape(lead)  # [T, B]
        with without_autocast(latent.device):
            latent = latent.reshape(*lead, latent.shape[-1])
            latent = latent if latent.dtype == torch.float64 else latent.float()  # [T, B, D]
            if mask is not None:
                latent = torch.where(mask.unsqueeze(-1), latent, 0.0)
            step = self.max_knot / (self.num_knots - 1)
            directions = self._draw(latent.shape[-1]).to(latent.dtype)  # [D, M]
            knots = torch.arange(1, self.num_knots, device=latent.device, dtype=latent.dtype) * step  # 0 adds nothing
            gaussian = torch.exp(-knots.square() / 2)  # [K]
            width = torch.full_like(knots, 2 * step)  # both halves of a symmetric integral
            width = torch.cat([width[:-1], width[-1:] / 2])
            return epps_pulley(latent @ (step * directions), mask, gaussian, width * gaussian).mean()

    def _draw(self, dim: int) -> torch.Tensor:
        """Unit vectors [D, M] float32."""
        state = self.generator_state.clone()
        if self.training:
            self.generator_state[1] += 1
        directions = standard_normal(state, dim * self.num_directions).view(dim, self.num_directions)
        return directions / directions.norm(dim=0)


def standard_normal(state: torch.Tensor, count: int) -> torch.Tensor:
    """Standard normal numbers from a counter: a pure function of (seed, draw), the same on every device and rank.

    A host-side generator cannot be traced by ``torch.compile(fullgraph=True)`` and would have to be kept equal across
    ranks; a hash of the position (SplitMix64, Steele et al. 2014) followed by Box-Muller needs neither.

    Args:
        state: [2] int64, seed and number of the draw.
        count: numbers wanted.

    Returns:
        [count] float32.
    """
    half = (count + 1) // 2
    position = torch.arange(2 * half, device=state.device)  # int64; products wrap around
    stream = _mix(_mix(state[:1] * _GOLDEN + 1) + state[1:])
    bits = _mix(stream + (position + 1) * _GOLDEN)
    # 23 bits and a half fill a float32 mantissa: strictly between 0 and 1, so that no radius is 0 or infinite.
    uniform = (((bits >> 41) & 0x7FFFFF).float() + 0.5) / 2**23
    radius = (-2 * uniform[:half].log()).sqrt()
    angle = 2 * math.pi * uniform[half:]
    return torch.cat([radius * angle.cos(), radius * angle.sin()])[:count]


_GOLDEN = 0x9E3779B97F4A7C15 - 2**64


def _mix(bits: torch.Tensor) -> torch.Tensor:
    """Finaliser of SplitMix64 on int64; shifts are made logical by masking."""
    bits = (bits ^ ((bits >> 30) & (2**34 - 1))) * (0xBF58476D1CE4E5B9 - 2**64)
    bits = (bits ^ ((bits >> 27) & (2**37 - 1))) * (0x94D049BB133111EB - 2**64)
    return bits ^ ((bits >> 31) & (2**33 - 1))
