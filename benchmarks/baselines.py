"""Baselines: the networks and the objective in plain PyTorch, on the weights of this package.

Attention is :func:`textbook` (the formula) or :func:`fused` (``scaled_dot_product_attention``); SIGReg computes one sine and one
cosine for every knot. Nothing of this package but its weights and its random directions is used. Shapes: N rows, T tokens,
C channels.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import nn

from torchrl_ficreg import FICRegLoss
from torchrl_ficreg._device import bf16_speedup, has_fast_bf16, Precision
from torchrl_ficreg.modules.layers import IMAGENET_MEAN, IMAGENET_STD
from torchrl_ficreg.objectives.sigreg import standard_normal

Mix = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, bool], torch.Tensor]


def plain_terms(loss: FICRegLoss, clip: TensorDictBase, mix: Mix) -> dict[str, torch.Tensor]:
    """The four weighted terms.

    Args:
        loss: whose weights are used.
        clip: ``pixels`` [B, T, 3, H, W] uint8 and ``action`` [B, T, F * A].
        mix: :func:`textbook` or :func:`fused`.
    """
    encoder, predictor, inverse_model = (parts(loss, name) for name in ("encoder", "predictor", "inverse_model"))
    action = clip["action"][:, :-1]  # [B, T - 1, F * A]
    latent = plain_encoder(encoder, clip["pixels"], mix)  # [B, T, D]
    predicted = plain_predictor(predictor, latent[:, :-1], action, mix)  # [B, T - 1, D]
    sigreg = plain_sigreg(latent.transpose(0, 1).float(), directions(loss, latent.shape[-1]))
    real = latent.detach()
    recovered = inverse_model(real[:, :-1], real[:, 1:])
    imagined = plain_predictor(predictor, real[:, :-1], action, mix, track=False)
    for param in inverse_model.parameters():
        param.requires_grad_(False)
    recovered_imagined = inverse_model(real[:, :-1], imagined)
    for param in inverse_model.parameters():
        param.requires_grad_(True)
    return {
        "loss_pred": F.mse_loss(predicted.float(), latent[:, 1:].float()),
        "loss_sigreg": loss.sigreg_coeff * sigreg,
        "loss_idm": loss.idm_coeff * F.mse_loss(recovered.float(), action),
        "loss_consistency": loss.consistency_coeff * F.mse_loss(recovered_imagined.float(), action),
    }


def parts(loss: FICRegLoss, name: str) -> nn.Module:
    """The network of that name, with the parameters that the loss trains."""
    network = getattr(loss, name)
    getattr(loss, f"{name}_params").to_module(network, preserve_module_state=False)
    return network.module


def directions(loss: FICRegLoss, dim: int) -> torch.Tensor:
    """Unit vectors [D, M]: at the first call those that SIGReg draws, later ones from torch's global generator."""
    state, count = loss.sigreg.generator_state, dim * loss.sigreg.num_directions
    drawn = standard_normal(state, count) if state[1] == 0 else torch.randn(count)
    loss.sigreg.generator_state[1] += 1
    drawn = drawn.view(dim, -1)
    return drawn / drawn.norm(dim=0)


def plain_sigreg(latent: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Latents [T, B, D] float32 and directions [D, M] -> the statistic [], as published (arXiv 2511.08544)."""
    with torch.autocast("cpu", enabled=False):
        knots = torch.linspace(0, 3, 17)
        weights = torch.full((17,), 2 * 3 / 16)
        weights[[0, -1]] = 3 / 16
        gaussian = torch.exp(-knots.square() / 2)
        angle = (latent @ directions).unsqueeze(-1) * knots  # [T, B, M, 17]
        error = (angle.cos().mean(-3) - gaussian).square() + angle.sin().mean(-3).square()  # [T, M, 17]
        return ((error @ (weights * gaussian)) * latent.shape[-2]).mean()


class PlainSIGReg(nn.Module):
    """:func:`plain_sigreg` with 1,024 random directions."""

    def forward(self, latent: torch.Tensor, directions: torch.Tensor | None = None) -> torch.Tensor:
        """Latents [T, B, D] -> []."""
        if directions is None:
            directions = torch.randn(latent.shape[-1], 1024)
            directions = directions / directions.norm(dim=0)
        return plain_sigreg(latent, directions)


def plain_encoder(network: nn.Module, pixels: torch.Tensor, mix: Mix) -> torch.Tensor:
    """The encoder as a textbook writes it: [B, T, 3, H, W] uint8 -> [B, T, D]."""
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in (IMAGENET_MEAN, IMAGENET_STD))
    frames = (pixels.flatten(0, 1).float() / 255 - mean) / std  # [N, 3, H, W]
    if hasattr(network, "convolutions"):
        return plain_convolutions(network, frames).unflatten(0, pixels.shape[:2])
    size = network.patch_size
    kernel = network.to_patch.weight.view(-1, 3, size, size)
    tokens = F.conv2d(frames, kernel, network.to_patch.bias, stride=size).flatten(2).transpose(1, 2)
    tokens = torch.cat([network.class_token.expand(len(tokens), -1, -1), tokens], dim=1) + network.position
    for block in network.blocks:
        tokens = tokens + plain_attention(block.attn, plain_norm(block.attn_norm, tokens), mix, causal=False)
        tokens = tokens + plain_mlp(block.mlp, plain_norm(block.mlp_norm, tokens))
    latent = plain_projector(network.projector, plain_norm(network.norm, tokens)[:, 0])
    return latent.unflatten(0, pixels.shape[:2])


def plain_convolutions(network: nn.Module, frames: torch.Tensor) -> torch.Tensor:
    """The small encoders: [N, 3, H, W] -> [N, D], in the memory layout of the frames."""
    maps = network.convolutions(frames)
    if hasattr(network, "projector"):
        return plain_projector(network.projector, maps.flatten(1))
    ends = (torch.linspace(-1, 1, size) for size in maps.shape[-2:])
    grid = torch.stack(torch.meshgrid(*ends, indexing="ij")[::-1], -1).flatten(0, 1)  # [H * W, 2]
    with torch.autocast("cpu", enabled=False):
        places = (maps.float().flatten(-2).softmax(-1) @ grid).transpose(-1, -2).flatten(-2)  # [N, 2 K]
        return F.linear(network.norm(places), network.layer_out.weight, network.layer_out.bias)


def plain_predictor(
    network: nn.Module, latent: torch.Tensor, action: torch.Tensor, mix: Mix, *, track: bool = True
) -> torch.Tensor:
    """The predictor as a textbook writes it: [B, T, D] and [B, T, F * A] -> [B, T, D]; in the mode of the network.

    Args:
        network: the predictor's network, whose weights are used.
        latent: [B, T, D].
        action: [B, T, F * A].
        mix: :func:`textbook` or :func:`fused`.
        track: whether BatchNorm layers in training mode update their running statistics.
    """
    x = network.to_width(latent) + network.position[:, : latent.shape[1]]
    embedding = network.action_embedding
    condition = embedding.layer_out(F.silu(embedding.layer_in(embedding.compress(action))))
    for block in network.blocks:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = block.to_modulation(F.silu(condition)).chunk(6, dim=-1)
        h = plain_norm(block.attn_norm, plain_norm(block.adaptive_norm, x) * (1 + scale_a) + shift_a)
        x = x + gate_a * plain_attention(block.attn, h, mix, causal=True)
        h = plain_norm(block.mlp_norm, plain_norm(block.adaptive_norm, x) * (1 + scale_m) + shift_m)
        x = x + gate_m * plain_mlp(block.mlp, h)
    return plain_projector(network.projector, plain_norm(network.norm, x).flatten(0, 1), track).unflatten(
        0, latent.shape[:2]
    )


def plain_norm(layer: nn.LayerNorm, x: torch.Tensor) -> torch.Tensor:
    """[..., C] -> [..., C]."""
    return F.layer_norm(x, layer.normalized_shape, layer.weight, layer.bias, layer.eps)


def textbook(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool) -> torch.Tensor:
    """Softmax attention by its formula: [N, heads, T, dim_head] each, and so returned."""
    scores = query @ key.transpose(-2, -1) / query.shape[-1] ** 0.5  # [N, heads, T, T]
    if causal:
        scores = scores.masked_fill(torch.ones(scores.shape[-2:], dtype=torch.bool).triu(1), -torch.inf)
    return scores.softmax(-1) @ value


def fused(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool) -> torch.Tensor:
    """As :func:`textbook`, by torch's own kernel."""
    return F.scaled_dot_product_attention(query, key, value, is_causal=causal)


def plain_attention(layer: nn.Module, x: torch.Tensor, mix: Mix, causal: bool) -> torch.Tensor:
    """[N, T, C] -> [N, T, C]."""
    projected = F.linear(x, layer.to_qkv.weight, layer.to_qkv.bias)
    query, key, value = (part.unflatten(-1, (layer.heads, -1)).transpose(1, 2) for part in projected.chunk(3, dim=-1))
    mixed = mix(query, key, value, causal).transpose(1, 2).flatten(2)
    return F.dropout(F.linear(mixed, layer.to_out.weight, layer.to_out.bias), layer.dropout.p, layer.training)


def plain_mlp(layers: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """[N, T, C] -> [N, T, C]."""
    rate, training = layers[2].p, layers.training
    hidden = F.dropout(F.gelu(F.linear(x, layers[0].weight, layers[0].bias)), rate, training)
    return F.dropout(F.linear(hidden, layers[3].weight, layers[3].bias), rate, training)


def plain_projector(layer: nn.Module, x: torch.Tensor, track: bool = True) -> torch.Tensor:
    """[N, C] -> [N, D]."""
    norm = layer.norm
    statistics = (norm.running_mean, norm.running_var) if track or not norm.training else (None, None)
    hidden = F.linear(x, layer.layer_in.weight, layer.layer_in.bias)
    hidden = F.gelu(F.batch_norm(hidden, *statistics, norm.weight, norm.bias, norm.training))
    return F.linear(hidden, layer.layer_out.weight, layer.layer_out.bias)


def plain_precisions() -> list[Precision]:
    """Precisions in which the plain formulation may be fastest; without bfloat16 where its products take over twice as long."""
    return ["fp32", "bf16"] if bf16_speedup() > 0.5 else ["fp32"]


def matrix_rate() -> float:
    """Operations per second of a large matrix product in the faster precision."""
    a, b = torch.randn(2, 2048, 2048).to(torch.bfloat16 if has_fast_bf16("cpu") else torch.float32)
    times = []
    for _ in range(20):
        began = time.perf_counter()
        a @ b
        times.append(time.perf_counter() - began)
    return 2 * 2048**3 / min(times)
