"""SIGReg: sketched isotropic Gaussian regularisation, its statistic and its random directions."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import nn

from torchrl_ficreg._device import without_autocast
from torchrl_ficreg._torchrl_compat import in_functorch_transform
from torchrl_ficreg.distributed import all_reduce_sum


class SIGReg(nn.Module):
    r"""Distance of a batch of latents from an isotropic Gaussian, along random directions (arXiv 2511.08544).

    Along each of M random unit vectors the empirical characteristic function of the B projections is compared with
    that of N(0, 1) (Epps-Pulley test):

    .. math:: B \int_{-t_{max}}^{t_{max}} |\hat\varphi(t) - e^{-t^2/2}|^2 \, e^{-t^2/2} dt

    by the trapezoidal rule, then averaged over directions and time steps. The value on N(0, I) is about 1.05 at any
    batch size; collapse to a point at zero gives 0.402 B. Because of the factor B a weight belongs to a batch size.

    In train mode each call draws new directions from a generator whose state is a buffer: it is saved in checkpoints, and the
    draws depend neither on the global random state nor on the device. In eval mode the next directions are used without
    advancing the state.

    On several ranks of a process group all draw the same directions, and the statistic is that of the global batch. Its
    gradient follows the convention of distributed data parallel training: averaged over ranks, parameter gradients are
    those of one process on the global batch.

    Args:
        num_directions (int, optional): M. Default: ``1024``.
        num_knots (int, optional): knots on [0, t_max]. Default: ``17``.
        max_knot (float, optional): t_max. Default: ``3.0``.
        unit ("time" or "batch_time", optional): ``"time"`` tests each time step of a [T, B, D] batch separately, as published,
            ``"batch_time"`` all T x B latents together. Default: ``"time"``.
        seed (int, optional): of the directions. Default: ``0``.

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
        """Computes the statistic; differentiable once in ``latent``.

        Args:
            latent (torch.Tensor): [T, B, D] or [B, D].
            mask (torch.Tensor, optional): [T, B] or [B] bool; false latents are left out, even if not finite. Default: ``None``.

        Returns:
            torch.Tensor: [], at least float32, inside autocast too.
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


def epps_pulley(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Epps-Pulley statistic of projections against N(0, 1), over the global batch of all ranks.

    Args:
        angle (torch.Tensor): [T, B, M], projections times the first knot.
        mask (torch.Tensor or None): [T, B] bool; false samples are left out.
        gaussian (torch.Tensor): [K], characteristic function of N(0, 1) at the knots.
        weight (torch.Tensor): [K], quadrature weights.

    Returns:
        torch.Tensor: [T, M], B times the weighted squared distance; differentiable once in ``angle``.
    """
    if in_functorch_transform():  # torch.func cannot differentiate a custom operator
        return _composite(angle, mask, gaussian, weight)
    return _epps_pulley(angle, mask, gaussian, weight)[0]


def _composite(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """As :func:`epps_pulley`, from operators of torch: all knots at once, in K times the memory."""
    order = torch.arange(1, len(weight) + 1, device=angle.device, dtype=angle.dtype).view(-1, 1, 1, 1)
    phase = order * angle  # [K, T, B, M]
    unit = torch.stack([phase.cos(), phase.sin()])  # [2, K, T, B, M]
    unit = unit if mask is None else torch.where(mask.unsqueeze(-1), unit, 0.0)
    count = all_reduce_sum(_counts(angle, mask))  # [T]
    cos, sin = all_reduce_sum(unit.sum(-2)) / count.clamp_min(1).unsqueeze(-1)  # each [K, T, M]
    distance = (cos - gaussian.view(-1, 1, 1)).square() + sin.square()
    return count.unsqueeze(-1) * torch.einsum("ktm,k->tm", distance, weight)


# A custom operator: torch.compile does not trace into it; inductor generates no code for complex arithmetic.
@torch.library.custom_op("torchrl_ficreg::epps_pulley", mutates_args=())
def _epps_pulley(
    angle: torch.Tensor, mask: torch.Tensor | None, gaussian: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Statistic [T, M], z [T, B, M] complex, deviation from the Gaussian [K, T, M] complex."""
    angle = angle.contiguous()  # a compiler may choose another layout; register_fake promises contiguous results
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
    total = torch.view_as_complex(all_reduce_sum(torch.view_as_real(total)))  # no backend has to know complex numbers
    count = all_reduce_sum(_counts(angle, mask))  # [T]
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
    grad = all_reduce_sum(grad)
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


def standard_normal(state: torch.Tensor, count: int) -> torch.Tensor:
    """Counter-based standard normal numbers: a pure function of seed and draw, the same on every device and rank.

    A hash of the position (SplitMix64, Steele et al. 2014) followed by the Box-Muller transform. A ``torch.Generator`` could
    not be traced by ``torch.compile(fullgraph=True)``, and its state would have to be synchronised between ranks.

    Args:
        state (torch.Tensor): [2] int64, seed and index of the draw.
        count (int): how many numbers.

    Returns:
        torch.Tensor: [count] float32.
    """
    half = (count + 1) // 2
    position = torch.arange(2 * half, device=state.device)  # int64; products wrap around
    stream = _splitmix64(_splitmix64(state[:1] * _SPLITMIX_STEP + 1) + state[1:])
    bits = _splitmix64(stream + (position + 1) * _SPLITMIX_STEP)
    # 23 bits plus one half fit a float32 mantissa: strictly between 0 and 1, so that no radius is 0 or infinite.
    uniform = (((bits >> 41) & 0x7FFFFF).float() + 0.5) / 2**23
    radius = (-2 * uniform[:half].log()).sqrt()
    angle = 2 * math.pi * uniform[half:]
    return torch.cat([radius * angle.cos(), radius * angle.sin()])[:count]


_SPLITMIX_STEP = 0x9E3779B97F4A7C15 - 2**64


def _splitmix64(bits: torch.Tensor) -> torch.Tensor:
    """Finaliser of SplitMix64 on int64; masks turn arithmetic shifts into logical ones."""
    bits = (bits ^ ((bits >> 30) & (2**34 - 1))) * (0xBF58476D1CE4E5B9 - 2**64)
    bits = (bits ^ ((bits >> 27) & (2**37 - 1))) * (0x94D049BB133111EB - 2**64)
    return bits ^ ((bits >> 31) & (2**33 - 1))
