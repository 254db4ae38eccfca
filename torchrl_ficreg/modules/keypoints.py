"""Keypoint encoder for small frames: spatial soft-argmax over learned feature maps (arXiv 1504.00702)."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg._device import convolution_region, without_autocast
from torchrl_ficreg.keys import LATENT, PIXELS
from torchrl_ficreg.modules.layers import (
    channels_last,
    GlobalBatchNorm1d,
    keep_arguments,
    PixelNormalizer,
    unflatten_batch,
)

_STRIDE = 4  # pixels between neighbouring places of a map


def spatial_softmax(maps: torch.Tensor) -> torch.Tensor:
    """Expected position under the softmax of each feature map (arXiv 1504.00702), in at least float32.

    Args:
        maps (Tensor): [N, K, H, W].

    Returns:
        [N, 2 K] in [-1, 1]: x of all maps, then y; -1 is left and top.

    Examples:
        >>> maps = torch.full((1, 1, 3, 3), -50.0)
        >>> maps[0, 0, 2, 0] = 50.0  # lower left
        >>> spatial_softmax(maps).tolist()
        [[-1.0, 1.0]]
    """
    height, width = maps.shape[-2:]
    maps = maps if maps.dtype == torch.float64 else maps.float()
    x = torch.linspace(-1, 1, width, device=maps.device, dtype=maps.dtype)
    y = torch.linspace(-1, 1, height, device=maps.device, dtype=maps.dtype)
    grid = torch.stack([x.repeat(height), y.repeat_interleave(width)], -1)  # [H * W, 2]
    share = maps.flatten(-2).softmax(-1)  # [N, K, H * W]
    return (share @ grid).transpose(-1, -2).flatten(-2)  # [N, K, 2] -> [N, 2 K]


class KeypointNetwork(nn.Module):
    """Patches of 4 x 4 pixels, convolutions on their grid, the position of each map, and a linear layer on the positions.

    A latent is a linear function of positions in the frame. This keeps the encoder from filling the latent with ever
    finer functions of the one quantity that is easiest to predict.

    Args:
        image_size (int, optional): H = W of the frames, a multiple of 4. Default: ``64``.
        channels (tuple of int, optional): channels of the patches and of the two 3 x 3 convolutions before the maps.
            Default: ``(32, 32, 32)``.
        num_keypoints (int, optional): K, number of maps. Default: ``32``.
        latent_dim (int, optional): D. Default: ``16``.

    Raises:
        ValueError: an image size that is no multiple of 4, or other than three channels.
    """

    @keep_arguments
    def __init__(
        self,
        *,
        image_size: int = 64,
        channels: tuple[int, ...] = (32, 32, 32),
        num_keypoints: int = 32,
        latent_dim: int = 16,
    ) -> None:
        super().__init__()
        if image_size < _STRIDE or image_size % _STRIDE:
            raise ValueError(f"image_size {image_size} must be a positive multiple of {_STRIDE}, the side of a patch.")
        if len(channels) != 3:
            raise ValueError(f"a keypoint encoder has three layers before its maps, got channels {channels}.")
        first, second, third = channels
        self.normalize = PixelNormalizer(image_size)
        # Channels last: the layout of bfloat16 convolutions on CPUs.
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, first, kernel_size=_STRIDE, stride=_STRIDE),
            nn.GELU(),
            nn.Conv2d(first, second, kernel_size=3, padding=1),
            nn.GELU(),
            nn.Conv2d(second, third, kernel_size=3, padding=1),
            nn.GELU(),
            nn.Conv2d(third, num_keypoints, kernel_size=1),
        ).to(memory_format=torch.channels_last)
        self.norm = GlobalBatchNorm1d(2 * num_keypoints)
        self.layer_out = nn.Linear(2 * num_keypoints, latent_dim)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """[..., 3, H, W] -> [..., D]."""
        frames = channels_last(self.normalize(pixels))  # [N, 3, H, W]
        with convolution_region(frames.device):
            maps = self.convolutions(frames)  # [N, K, H / 4, W / 4]
        # Positions are precise to a fraction of a pixel, which bfloat16 would round away.
        with without_autocast(pixels.device):
            places = self.norm(spatial_softmax(maps).to(self.layer_out.weight.dtype))  # [N, 2 K]
            return unflatten_batch(self.layer_out(places), pixels)


class KeypointEncoder(TensorDictModule):
    """Encoder for small frames with several moving objects: ``pixels`` [..., 3, H, W] -> ``latent`` [..., D].

    Args:
        in_key (NestedKey, optional): where frames are read. Default: ``"pixels"``.
        out_key (NestedKey, optional): where latents are written. Default: ``"latent"``.
        **network: arguments of :class:`KeypointNetwork`.

    Raises:
        TypeError, ValueError: see :class:`~torchrl_ficreg.modules.layers.PixelNormalizer`.

    Examples:
        >>> from tensordict import TensorDict
        >>> encoder = KeypointEncoder(latent_dim=8).eval()
        >>> clip = TensorDict({"pixels": torch.rand(2, 4, 3, 64, 64)}, [2, 4])
        >>> encoder(clip)["latent"].shape
        torch.Size([2, 4, 8])
    """

    def __init__(self, *, in_key: NestedKey = PIXELS, out_key: NestedKey = LATENT, **network) -> None:
        super().__init__(KeypointNetwork(**network), in_keys=[in_key], out_keys=[out_key])
