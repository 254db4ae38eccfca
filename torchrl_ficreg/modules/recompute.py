"""Activation checkpointing: memory for a second forward pass (arXiv 1604.06174)."""

from __future__ import annotations

import torch
from torch import nn
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint


def checkpoint_activations(*networks: nn.Module, enabled: bool = True) -> None:
    """Switches activation checkpointing of every transformer inside the networks on or off.

    Between its blocks nothing but their inputs is kept for the backward pass, which computes the rest again: the same
    gradients to the last bit, dropout included, at the cost of one more forward pass. To be called before a loss is
    built from the networks.

    Args:
        *networks: an encoder, a predictor, a world model ...
        enabled: on or off.

    Raises:
        ValueError: there is no transformer to switch.

    Examples:
        >>> from torchrl_ficreg import ViTEncoder
        >>> encoder = ViTEncoder(image_size=28, depth=2)
        >>> checkpoint_activations(encoder)
        >>> encoder.module.checkpointing
        True
    """
    found = [part for network in networks for part in network.modules() if hasattr(part, "checkpointing")]
    if not found:
        raise ValueError("none of these networks has transformer blocks whose activations could be computed again.")
    for part in found:
        part.checkpointing = enabled


def run_block(block: nn.Module, *inputs: torch.Tensor, again: bool) -> torch.Tensor:
    """``block(*inputs)``; with ``again``, and where gradients are wanted, its activations are not kept."""
    if not (again and torch.is_grad_enabled()):
        return block(*inputs)
    # By the time of the backward pass a functional loss has taken its parameters out of the module.
    tensors = {**dict(block.named_parameters()), **dict(block.named_buffers())}
    return checkpoint(lambda *x: functional_call(block, tensors, x), *inputs, use_reentrant=False)
