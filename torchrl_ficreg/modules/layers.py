"""Layers shared by the networks: batch normalisation over all ranks, projector, pixel preprocessing."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from torchrl_ficreg._torchrl_compat import (
    check_batch_norm_input,
    FakeTensor,
    in_functorch_transform,
    is_functorch_wrapped_tensor,
)
from torchrl_ficreg.distributed import all_reduce_sum, world_size


def keep_arguments(init: Callable[..., None]) -> Callable[..., None]:
    """Decorator of a network's ``__init__``: its arguments, defaults included, stay in the dict ``arguments``.

    Saved models hold these arguments; they build the same network again. Of a subclass that is decorated too, its own
    arguments are kept.

    Examples:
        >>> class Scale(nn.Module):
        ...     @keep_arguments
        ...     def __init__(self, width, factor=2.0):
        ...         super().__init__()
        >>> Scale(3).arguments
        {'width': 3, 'factor': 2.0}
    """
    signature = inspect.signature(init)

    @functools.wraps(init)
    def wrapper(self, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **kwargs)
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        self.arguments = dict(list(bound.arguments.items())[1:])  # without self

    return wrapper


class GlobalBatchNorm1d(nn.BatchNorm1d):
    """``nn.BatchNorm1d`` whose statistics, in training, are those of the global batch.

    In one process it is exactly ``nn.BatchNorm1d``: the same parameters, buffers and numbers. With ``torch.distributed``
    initialised, counts and sums are reduced over all ranks, and gradients flow back through the reductions.
    ``nn.SyncBatchNorm`` does the same on accelerators only; this layer works with every backend.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, C] -> [N, C], or [N, C, L] -> [N, C, L]."""
        measures = self.training or self.running_mean is None
        if not measures or world_size() == 1:
            return super().forward(x)
        check_batch_norm_input(self, x)
        if x.ndim == 3:
            rows = self._forward_global(x.transpose(1, 2).flatten(0, 1))  # [N * L, C]
            return rows.unflatten(0, (len(x), -1)).transpose(1, 2)
        return self._forward_global(x)

    def _forward_global(self, x: torch.Tensor) -> torch.Tensor:
        wide = x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
        count = all_reduce_sum(wide.new_full((1,), len(x)))  # [1]
        mean = all_reduce_sum(wide.sum(0)) / count  # [C]
        variance = all_reduce_sum((wide - mean).square().sum(0)) / count  # [C]
        if self.training and self.running_mean is not None:
            self._track(mean.detach(), variance.detach(), count)
        normed = (wide - mean) * torch.rsqrt(variance + self.eps)
        return (normed if self.weight is None else normed * self.weight + self.bias).to(x.dtype)

    def _track(self, mean: torch.Tensor, variance: torch.Tensor, count: torch.Tensor) -> None:
        """Updates the running statistics; without a momentum they are plain averages, as in torch."""
        self.num_batches_tracked.add_(1)  # += would assign an attribute, which breaks a compiled graph
        share = 1 / self.num_batches_tracked.to(mean.dtype) if self.momentum is None else self.momentum
        unbiased = variance * count / (count - 1).clamp_min(1)
        self.running_mean.add_(share * (mean - self.running_mean))
        self.running_var.add_(share * (unbiased - self.running_var))


class Projector(nn.Module):
    """Linear, BatchNorm, GELU, linear: removes the constraint that a final LayerNorm puts on latents (arXiv 2603.19312).

    SIGReg drives latents towards an isotropic Gaussian over the batch. A final LayerNorm projects every latent onto a
    sphere, which a loss on batch statistics cannot undo; a BatchNorm normalises over the batch instead.

    Args:
        in_dim (int): width of the input.
        hidden_dim (int): width of the hidden layer.
        out_dim (int): width of the output.
    """

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.layer_in = nn.Linear(in_dim, hidden_dim)
        self.norm = GlobalBatchNorm1d(hidden_dim)
        self.layer_out = nn.Linear(hidden_dim, out_dim)
        self.activation = nn.GELU()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[..., in_dim] -> [..., out_dim]; statistics over all leading dimensions."""
        hidden = self.layer_in(x.flatten(0, -2))  # [N, hidden]
        return self.layer_out(self.activation(self.norm(hidden))).unflatten(0, x.shape[:-1])


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_ROUNDING = 1e-3  # how far half precision or interpolation may move a pixel out of 0..1


def check_finite(pixels: torch.Tensor) -> None:
    """Checks that floating pixels are finite: a NaN would stay in the running statistics of BatchNorm.

    Raises:
        ValueError: a pixel is NaN or infinite.
    """
    extremes = _extremes(pixels)
    if extremes is not None and not all(map(math.isfinite, extremes)):
        raise ValueError(f"pixels {list(pixels.shape)} hold a NaN or an infinity: drop those frames, or keep them as uint8.")


def has_values(tensor: torch.Tensor) -> bool:
    """Whether the values of a tensor can be read: not in a traced or captured graph, under ``vmap``, or on meta."""
    if torch.compiler.is_compiling() or tensor.is_meta or isinstance(tensor, FakeTensor):
        return False
    captured = tensor.is_cuda and torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()
    return not (captured or is_functorch_wrapped_tensor(tensor))


def _extremes(pixels: torch.Tensor) -> tuple[float, float] | None:
    """Smallest and largest value, NaN if any value is NaN. None for integers, and where values cannot be read."""
    if not (has_values(pixels) and pixels.is_floating_point() and pixels.numel()):
        return None
    low, high = torch.stack(pixels.detach().aminmax()).tolist()  # one transfer from an accelerator
    return low, high


class PixelNormalizer(nn.Module):
    """Frames [..., 3, H, W] to floats [N, 3, H, W], normalised by the statistics of ImageNet.

    Args:
        image_size (int): H = W of the frames.

    Raises:
        TypeError: pixels are neither uint8 (0..255) nor floating (0..1).
        ValueError: pixels have another shape, or floating ones a value outside 0..1.
    """

    def __init__(self, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        std = torch.tensor(IMAGENET_STD).view(3, 1, 1)
        mean = torch.tensor(IMAGENET_MEAN).view(3, 1, 1)
        # Constants, which are not part of a checkpoint.
        self.register_buffer("shift", -mean / std, persistent=False)
        self.register_buffer("scale", 1 / std, persistent=False)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """[..., 3, H, W] uint8 in 0..255 or floating in 0..1 -> [N, 3, H, W] in the parameters' dtype."""
        size = (3, self.image_size, self.image_size)
        if pixels.shape[-3:] != size:
            raise ValueError(
                f"pixels must be [..., {size[0]}, {size[1]}, {size[2]}] (channels first), got {list(pixels.shape)}: "
                "permute the channels, or build the encoder with another image_size."
            )
        frames = pixels.flatten(0, -4) if pixels.ndim > 3 else pixels[None]  # [N, 3, H, W]
        if pixels.dtype == torch.uint8:
            return frames.to(self.scale.dtype).mul_(self.scale / 255).add_(self.shift)  # in place on a copy
        if pixels.is_floating_point():
            extremes = _extremes(pixels)
            if extremes is not None and not -_ROUNDING <= extremes[0] <= extremes[1] <= 1 + _ROUNDING:  # true of NaN too
                raise ValueError(
                    f"floating pixels must lie in 0..1, got {extremes[0]:.4g} to {extremes[1]:.4g}: divide 0..255 by 255 or "
                    "convert it to uint8, undo a normalisation (the encoder has its own), and drop frames with a NaN."
                )
            return frames.to(self.scale.dtype) * self.scale + self.shift
        raise TypeError(f"pixels must be uint8 (0..255) or floating (0..1), got {pixels.dtype}: convert them.")


def channels_last(frames: torch.Tensor) -> torch.Tensor:
    """Frames [N, 3, H, W] in the layout of fast convolutions; unchanged under ``vmap``, which has no memory formats."""
    if in_functorch_transform():
        return frames
    return frames.contiguous(memory_format=torch.channels_last)


def unflatten_batch(latent: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """[N, D] -> [..., D] with the leading dimensions of pixels [..., 3, H, W]."""
    return latent.unflatten(0, pixels.shape[:-3]) if pixels.ndim > 3 else latent[0]
