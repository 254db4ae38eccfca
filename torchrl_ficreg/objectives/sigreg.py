"""Sketched isotropic Gaussian regularisation."""

from __future__ import annotations

import torch
from torch import nn
from torch.autograd.function import once_differentiable


class SIGReg(nn.Module):
    r"""Distance of a batch of latents from an isotropic Gaussian, seen along random directions (arXiv 2511.08544).

    Along each of M random unit vectors the empirical characteristic function of the B projections is compared with
    that of N(0, 1) (Epps-Pulley test):

    .. math:: B \int_{-t_{max}}^{t_{max}} |\hat\varphi(t) - e^{-t^2/2}|^2 \, e^{-t^2/2} dt

    by the trapezoidal rule, then averaged over directions and time steps. The value on N(0, I) is about 1.05 at any
    batch size; collapse to a point at zero gives 0.402 B. Because of the factor B a weight belongs to a batch size.

    Args:
        num_directions: M, drawn anew at every call from torch's global generator.
        num_knots: knots on [0, t_max].
        max_knot: t_max.

    Raises:
        ValueError: fewer than one direction or two knots, or latents that are not [T, B, D] with B >= 2.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> round(SIGReg()(torch.randn(4, 128, 192)).item(), 1)
        1.1
    """

    def __init__(self, num_directions: int = 1024, num_knots: int = 17, max_knot: float = 3.0) -> None:
        super().__init__()
        if num_directions < 1 or num_knots < 2 or max_knot <= 0:
            raise ValueError(
                "SIGReg needs num_directions >= 1, num_knots >= 2 and max_knot > 0, "
                f"got {num_directions}, {num_knots} and {max_knot}."
            )
        self.num_directions = num_directions
        self.knot_step = max_knot / (num_knots - 1)
        knots = torch.arange(1, num_knots) * self.knot_step  # the knot at 0 contributes nothing
        gaussian = torch.exp(-knots.square() / 2)
        widths = torch.full_like(knots, 2 * self.knot_step)  # both halves of a symmetric integral
        widths[-1] = self.knot_step
        self.register_buffer("gaussian", gaussian, persistent=False)  # [K]
        self.register_buffer("weight", widths * gaussian, persistent=False)  # [K]

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Latents [T, B, D], or [B, D] -> the statistic [], float32 inside any autocast."""
        if latent.ndim not in (2, 3) or latent.shape[-2] < 2:
            raise ValueError(f"SIGReg takes latents [T, B, D] or [B, D] with B >= 2, got {list(latent.shape)}.")
        with torch.autocast(latent.device.type, enabled=False):
            latent = latent.float()
            directions = torch.randn(latent.shape[-1], self.num_directions, device=latent.device)  # [D, M]
            directions = directions / directions.norm(dim=0)
            angle = latent @ (self.knot_step * directions)  # [T, B, M]: angle at the first knot
            return _EppsPulley.apply(angle, self.gaussian, self.weight).mean()


class _EppsPulley(torch.autograd.Function):
    """Epps-Pulley statistic of angles [..., B, M] -> [..., M].

    All knots are multiples of the first, so one sine and cosine per angle give the others by angle addition. The
    gradient is a trigonometric polynomial in the same pair, evaluated by Horner's rule: two tensors are kept, not
    one pair for every knot.
    """

    @staticmethod
    def forward(ctx, angle: torch.Tensor, gaussian: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        cos, sin = angle.cos(), angle.sin()  # [..., B, M]
        knot_cos, knot_sin = cos, sin
        real, imaginary = [cos.mean(-2)], [sin.mean(-2)]
        for _ in range(len(gaussian) - 1):
            knot_cos, knot_sin = knot_cos * cos - knot_sin * sin, knot_sin * cos + knot_cos * sin
            real.append(knot_cos.mean(-2))
            imaginary.append(knot_sin.mean(-2))
        deviation = torch.stack(real, -1) - gaussian  # [..., M, K]
        skew = torch.stack(imaginary, -1)  # [..., M, K]
        ctx.save_for_backward(cos, sin, deviation, skew, weight)
        return angle.shape[-2] * ((deviation.square() + skew.square()) @ weight)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        cos, sin, deviation, skew, weight = ctx.saved_tensors
        order = torch.arange(1, len(weight) + 1, device=weight.device, dtype=weight.dtype)
        slope = (2 * order * weight) * grad.unsqueeze(-1)  # [..., M, K]
        # d/d(angle) = sum_k slope_k (skew_k cos(k angle) - deviation_k sin(k angle)), the real part of
        # sum_k slope_k (skew_k + i deviation_k) exp(i k angle).
        real = (slope * skew).movedim(-1, 0).unsqueeze(-2)  # [K, ..., 1, M]
        imaginary = (slope * deviation).movedim(-1, 0).unsqueeze(-2)
        total_real, total_imaginary = real[-1], imaginary[-1]
        for k in range(len(weight) - 2, -1, -1):
            total_real, total_imaginary = (
                total_real * cos - total_imaginary * sin + real[k],
                total_imaginary * cos + total_real * sin + imaginary[k],
            )
        return total_real * cos - total_imaginary * sin, None, None
