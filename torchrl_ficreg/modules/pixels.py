"""From stored frames to what an encoder network eats."""

from __future__ import annotations

import math

import torch
from torch import nn
from torch._C._functorch import is_functorch_wrapped_tensor
from torch._subclasses import FakeTensor

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_ROUNDING = 1e-3  # how far half precision or an interpolation may take a pixel out of 0..1


def check_finite(pixels: torch.Tensor) -> None:
    """Refuses floating pixels with a NaN or an infinity, which BatchNorm would keep in its running statistics for good.

    Raises:
        ValueError: there is one.
    """
    extremes = _extremes(pixels)
    if extremes is not None and not all(map(math.isfinite, extremes)):
        raise ValueError(f"pixels {list(pixels.shape)} hold a NaN or an infinity: drop those frames, or keep them as uint8.")


def has_values(tensor: torch.Tensor) -> bool:
    """Whether the numbers of a tensor can be looked at: not while it is traced, captured, faked or mapped, nor on meta."""
    if torch.compiler.is_compiling() or tensor.is_meta or isinstance(tensor, FakeTensor):
        return False
    captured = tensor.is_cuda and torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()
    return not (captured or is_functorch_wrapped_tensor(tensor))


def _extremes(pixels: torch.Tensor) -> tuple[float, float] | None:
    """Smallest and largest value, NaN where there is one. None for integers, and where there is no value to be seen."""
    if not (has_values(pixels) and pixels.is_floating_point() and pixels.numel()):
        return None
    low, high = torch.stack(pixels.detach().aminmax()).tolist()  # one transfer from an accelerator
    return low, high


class PixelNormalizer(nn.Module):
    """Frames [..., 3, H, W] to normalised floats [N, 3, H, W], on the device they are on.

    Args:
        image_size: H = W that the network is built for.

    Raises:
        TypeError: pixels are neither uint8 (0..255) nor floating (0..1).
        ValueError: pixels have another shape, or floating ones a value outside 0..1.
    """

    def __init__(self, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        std = torch.tensor(IMAGENET_STD).view(3, 1, 1)
        mean = torch.tensor(IMAGENET_MEAN).view(3, 1, 1)
        # Kept as constants of the network, not of its state: a checkpoint holds what was learned.
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
            return frames.to(self.scale.dtype).mul_(self.scale / 255).add_(self.shift)  # a copy, free to be overwritten
        if pixels.is_floating_point():
            extremes = _extremes(pixels)
            if extremes is not None and not -_ROUNDING <= extremes[0] <= extremes[1] <= 1 + _ROUNDING:  # so is a NaN
                raise ValueError(
                    f"floating pixels must lie in 0..1, got {extremes[0]:.4g} to {extremes[1]:.4g}: divide 0..255 by 255 or "
                    "convert it to uint8, undo a normalisation (the encoder has its own), and drop frames with a NaN."
                )
            return frames.to(self.scale.dtype) * self.scale + self.shift
        raise TypeError(f"pixels must be uint8 (0..255) or floating (0..1), got {pixels.dtype}: convert them.")


def channels_last(frames: torch.Tensor) -> torch.Tensor:
    """Frames [N, 3, H, W] in the layout that convolutions on CPUs want; under ``vmap``, which knows none, as they are."""
    if torch._C._are_functorch_transforms_active():
        return frames
    return frames.contiguous(memory_format=torch.channels_last)


def restore_lead(latent: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """[N, D] -> [..., D] with the leading dimensions of pixels [..., 3, H, W]."""
    return latent.unflatten(0, pixels.shape[:-3]) if pixels.ndim > 3 else latent[0]
