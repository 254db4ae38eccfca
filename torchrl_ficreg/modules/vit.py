"""Vision transformer encoder (ViT-Tiny/14 in the paper)."""

from __future__ import annotations

from typing import get_args, Literal

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from torchrl_ficreg.keys import LATENT, PIXELS
from torchrl_ficreg.modules.layers import keep_arguments, PixelNormalizer, Projector, unflatten_batch
from torchrl_ficreg.modules.transformer import Block, run_block

Init = Literal["torch", "published"]


class VisionTransformer(nn.Module):
    """Class-token vision transformer (arXiv 2010.11929) with a BatchNorm projector on the class token.

    Args:
        image_size (int, optional): H = W of the frames, in pixels. Default: ``224``.
        patch_size (int, optional): height and width of a patch, in pixels. Default: ``14``.
        width (int, optional): channels of a token. Default: ``192``.
        depth (int, optional): number of blocks. Default: ``12``.
        heads (int, optional): attention heads of a block. Default: ``3``.
        mlp_dim (int, optional): hidden width of a block's feed-forward layer. Default: ``768``.
        projector_dim (int, optional): hidden width of the projector. Default: ``2048``.
        latent_dim (int, optional): D. Default: ``192``.
        init (str, optional): initialisation of the linear layers before the projector, including the patch projection.
            ``"torch"`` is PyTorch's default; ``"published"`` draws weights from a normal distribution of standard
            deviation 0.02, truncated at +-2, and sets biases to 0, as the encoder of the published code (transformers'
            ``ViTModel``) does. Default: ``"torch"``.

    Attributes:
        checkpointing: see :func:`~torchrl_ficreg.modules.transformer.checkpoint_activations`.

    Raises:
        ValueError: an unknown ``init``, or an ``image_size`` that is no multiple of ``patch_size``.
    """

    checkpointing = False

    @keep_arguments
    def __init__(
        self,
        *,
        image_size: int = 224,
        patch_size: int = 14,
        width: int = 192,
        depth: int = 12,
        heads: int = 3,
        mlp_dim: int = 768,
        projector_dim: int = 2048,
        latent_dim: int = 192,
        init: Init = "torch",
    ) -> None:
        super().__init__()
        if image_size % patch_size:
            raise ValueError(f"image_size {image_size} must be a multiple of patch_size {patch_size}.")
        if init not in get_args(Init):
            raise ValueError(f"unknown init {init!r}: choose one of {get_args(Init)}.")
        self.patch_size, self.init = patch_size, init
        num_patches = (image_size // patch_size) ** 2
        self.normalize = PixelNormalizer(image_size)
        self.to_patch = nn.Linear(3 * patch_size**2, width)
        self.class_token = nn.Parameter(torch.empty(1, 1, width))
        self.position = nn.Parameter(torch.empty(1, num_patches + 1, width))
        self.blocks = nn.ModuleList(Block(width, heads, mlp_dim) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=1e-12)
        self.projector = Projector(width, projector_dim, latent_dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws the class token, the position embedding and, under ``init="published"``, the linear layers."""
        nn.init.normal_(self.class_token, std=0.02)
        nn.init.normal_(self.position, std=0.02)
        if self.init == "torch":
            return  # the layers are initialised when they are built
        for layer in (self.to_patch, *self.blocks.modules()):
            if isinstance(layer, nn.Linear):
                nn.init.trunc_normal_(layer.weight, std=0.02)
                nn.init.zeros_(layer.bias)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """[..., 3, H, W] -> [..., D]."""
        frames = self.normalize(pixels)  # [N, 3, H, W]
        patches = frames.unfold(2, self.patch_size, self.patch_size).unfold(3, self.patch_size, self.patch_size)
        tokens = self.to_patch(patches.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2))  # [N, P, width]
        tokens = torch.cat([self.class_token.expand(len(tokens), -1, -1), tokens], dim=1) + self.position
        for block in self.blocks[:-1]:
            tokens = run_block(block, tokens, checkpointing=self.checkpointing)  # [N, P + 1, width]
        token = self.blocks[-1].first(tokens)[:, 0]  # [N, width]; only the class token is needed
        return unflatten_batch(self.projector(self.norm(token)), pixels)


class ViTEncoder(TensorDictModule):
    """Encoder for large frames: ``pixels`` [..., 3, H, W] -> ``latent`` [..., D].

    The default sizes are the paper's ViT-Tiny/14 at 224 pixels (arXiv 2603.19312), 6.3 M parameters with the projector;
    ``init="published"`` is its initialisation.

    Args:
        in_key (NestedKey, optional): where frames are read. Default: ``"pixels"``.
        out_key (NestedKey, optional): where latents are written. Default: ``"latent"``.
        **network: arguments of :class:`VisionTransformer`.

    Raises:
        TypeError, ValueError: see :class:`~torchrl_ficreg.modules.layers.PixelNormalizer`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> encoder = ViTEncoder(image_size=28, depth=1).eval()
        >>> clip = TensorDict({"pixels": torch.zeros(2, 4, 3, 28, 28, dtype=torch.uint8)}, [2, 4])
        >>> encoder(clip)["latent"].shape
        torch.Size([2, 4, 192])
    """

    def __init__(self, *, in_key: NestedKey = PIXELS, out_key: NestedKey = LATENT, **network) -> None:
        super().__init__(VisionTransformer(**network), in_keys=[in_key], out_keys=[out_key])
