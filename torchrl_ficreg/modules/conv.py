"""Convolutional encoder for small frames."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg._device import convolution_region
from torchrl_ficreg.keys import LATENT, PIXELS
from torchrl_ficreg.modules.layers import channels_last, keep_arguments, PixelNormalizer, Projector, unflatten_batch


class ConvNetwork(nn.Module):
    """Strided 4x4 convolutions, each halving the frame, and a BatchNorm projector on the flattened feature maps.

    Args:
        image_size (int, optional): H = W of the frames, a multiple of 2 ** len(channels). Default: ``64``.
        channels (tuple of int, optional): output channels of each convolution. Default: ``(16, 32, 64, 128)``.
        projector_dim (int, optional): hidden width of the projector. Default: ``128``.
        latent_dim (int, optional): D. Default: ``16``.
    """

    @keep_arguments
    def __init__(
        self,
        *,
        image_size: int = 64,
        channels: tuple[int, ...] = (16, 32, 64, 128),
        projector_dim: int = 128,
        latent_dim: int = 16,
    ) -> None:
        super().__init__()
        if image_size % 2 ** len(channels):
            raise ValueError(f"image_size {image_size} must be a multiple of {2 ** len(channels)}, one halving a layer.")
        self.normalize = PixelNormalizer(image_size)
        layers: list[nn.Module] = []
        for into, out in zip((3, *channels), channels):
            layers += [nn.Conv2d(into, out, kernel_size=4, stride=2, padding=1), nn.GELU()]
        # Channels last: the layout of bfloat16 convolutions on CPUs.
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)
        left = image_size // 2 ** len(channels)
        self.projector = Projector(channels[-1] * left**2, projector_dim, latent_dim)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """[..., 3, H, W] -> [..., D]."""
        frames = channels_last(self.normalize(pixels))  # [N, 3, H, W]
        with convolution_region(frames.device):
            maps = self.convolutions(frames)  # [N, C, H', W']
        return unflatten_batch(self.projector(maps.flatten(1)), pixels)


class ConvEncoder(TensorDictModule):
    """Encoder for small frames: ``pixels`` [..., 3, H, W] -> ``latent`` [..., D]. 0.4 M parameters, made for CPUs.

    Args:
        in_key (NestedKey, optional): where frames are read. Default: ``"pixels"``.
        out_key (NestedKey, optional): where latents are written. Default: ``"latent"``.
        **network: arguments of :class:`ConvNetwork`.

    Raises:
        TypeError, ValueError: see :class:`~torchrl_ficreg.modules.layers.PixelNormalizer`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> encoder = ConvEncoder(latent_dim=8).eval()
        >>> clip = TensorDict({"pixels": torch.rand(2, 4, 3, 64, 64)}, [2, 4])
        >>> encoder(clip)["latent"].shape
        torch.Size([2, 4, 8])
    """

    def __init__(self, *, in_key: NestedKey = PIXELS, out_key: NestedKey = LATENT, **network) -> None:
        super().__init__(ConvNetwork(**network), in_keys=[in_key], out_keys=[out_key])
