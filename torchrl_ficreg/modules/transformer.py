"""Transformer blocks: attention, the pre-norm block of encoders, the AdaLN-zero block of the predictor.

Also activation checkpointing of these blocks. Shapes: N sequences, T tokens, C channels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint

Cache = tuple[torch.Tensor, torch.Tensor]  # keys and values, each [N, heads, T, dim_head]

_MAX_ELEMENTWISE_TOKENS = 4  # up to this many, attention on CPUs is faster without matrix products


def attend(
    query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool, dropout: float = 0.0
) -> torch.Tensor:
    """Softmax attention: ``scaled_dot_product_attention``, except where CPUs have a faster way.

    In bfloat16, two matrix products around a softmax take about three quarters of the time of torch's fused CPU kernel
    in training. The windows of a few tokens that a planner predicts by the thousand are faster still without any
    matrix product.

    Args:
        query: [N, heads, Q, dim_head], any floating dtype.
        key: [N, heads, T, dim_head].
        value: [N, heads, T, dim_head].
        causal: each token attends to itself and earlier tokens only; requires Q = T.
        dropout: probability of dropping an attention weight; 0 outside of training. Default: ``0.0``.

    Returns:
        [N, heads, Q, dim_head].
    """
    if query.device.type == "cpu":
        infers = not dropout and not (torch.is_grad_enabled() and query.requires_grad)
        if infers and key.shape[-2] <= _MAX_ELEMENTWISE_TOKENS:
            return _attend_to_few(query, key, value, causal)
        if query.dtype == torch.bfloat16:
            return attend_by_products(query, key, value, causal, dropout)
    return F.scaled_dot_product_attention(query, key, value, is_causal=causal, dropout_p=dropout)


def attend_by_products(
    query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool, dropout: float = 0.0
) -> torch.Tensor:
    """As :func:`attend`, by its formula: softmax(query key^T / sqrt(dim_head)) value."""
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)  # [N, heads, Q, T]
    if causal:
        tokens = scores.shape[-1]
        future = torch.ones(tokens, tokens, dtype=torch.bool, device=scores.device).triu(1)  # [T, T]
        scores = scores.masked_fill(future, -torch.inf)
    weights = scores.softmax(-1).to(value.dtype)
    return (F.dropout(weights, dropout) if dropout else weights) @ value


def _attend_to_few(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool) -> torch.Tensor:
    """As :func:`attend`, token by token: matrix products of a few rows spend most of their time on copies."""
    keys, values, mixed = key.unbind(2), value.unbind(2), []  # each [N, heads, dim_head]
    for place, token in enumerate(query.unbind(2)):
        seen = place + 1 if causal else len(keys)
        if seen == 1:
            mixed.append(values[0])
            continue
        scores = torch.stack([(token * keys[i]).sum(-1, keepdim=True) for i in range(seen)])  # [seen, N, heads, 1]
        weights = (scores * query.shape[-1] ** -0.5).softmax(0)
        mix = weights[0] * values[0]
        for i in range(1, seen):
            mix = torch.addcmul(mix, weights[i], values[i])
        mixed.append(mix)
    return torch.stack(mixed, dim=1).transpose(1, 2)  # [N, Q, heads, dim_head] in memory, the layout of the next layer


class Attention(nn.Module):
    """Multi-head self-attention.

    Args:
        dim (int): C, channels of the tokens.
        heads (int): number of heads.
        dim_head (int): width of a head.
        causal (bool): each token attends to itself and earlier tokens only.
        qkv_bias (bool): whether the query, key and value projection has a bias.
        dropout (float, optional): dropout rate after the output projection. Default: ``0.0``.
        weight_dropout (float, optional): dropout rate of the attention weights. Default: ``0.0``.
    """

    def __init__(
        self,
        dim: int,
        heads: int,
        dim_head: int,
        *,
        causal: bool,
        qkv_bias: bool,
        dropout: float = 0.0,
        weight_dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.heads, self.causal, self.weight_dropout = heads, causal, weight_dropout
        self.inner = heads * dim_head
        self.to_qkv = nn.Linear(dim, 3 * self.inner, bias=qkv_bias)
        self.to_out = nn.Linear(self.inner, dim)
        self.dropout = nn.Dropout(dropout)

    def extra_repr(self) -> str:
        """Settings that no sub-module shows."""
        return f"heads={self.heads}, causal={self.causal}, weight_dropout={self.weight_dropout}"

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, T, C] -> [N, T, C]."""
        drop = self.weight_dropout if self.training else 0.0
        if x.shape[-2] == 1 and not drop:
            # A single token attends to itself only: its weight is 1 whatever query and key are.
            bias = self.to_qkv.bias[2 * self.inner :] if self.to_qkv.bias is not None else None
            mixed = F.linear(x, self.to_qkv.weight[2 * self.inner :], bias)  # [N, 1, inner]
        else:
            query, key, value = self._heads(self.to_qkv(x), 3).unbind(0)
            mixed = attend(query, key, value, self.causal, drop).transpose(1, 2).flatten(2)
        return self.dropout(self.to_out(mixed))  # of [N, T, inner]

    def first(self, x: torch.Tensor) -> torch.Tensor:
        """Only the first token of :meth:`forward`, without a causal mask: [N, T, C] -> [N, 1, C]."""
        mixed = attend(*self._one_query(x, 0), False).transpose(1, 2).flatten(2)  # [N, 1, inner]
        return self.dropout(self.to_out(mixed))

    def extend(
        self, x: torch.Tensor, past: Cache | None, *, last: bool, keep: bool
    ) -> tuple[torch.Tensor, Cache | None]:
        """Causal attention of new tokens after tokens whose keys and values are cached; no dropout.

        Args:
            x (Tensor): [N, T, C]; T = 1 with a past.
            past (tuple of Tensor, optional): keys and values of the P earlier tokens, each [N, heads, P, dim_head].
            last (bool): compute and return only the last token.
            keep (bool): also return the keys and values, for a next call.

        Returns:
            [N, T, C], or [N, 1, C] with ``last``, and the keys and values of all P + T tokens with ``keep``, else None.
        """
        if past is None and not keep and x.shape[-2] == 1:
            return self.forward(x), None
        if last and x.shape[-2] > 1:
            query, key, value = self._one_query(x, -1)
        else:
            query, key, value = self._heads(self.to_qkv(x), 3).unbind(0)
        if past is not None:
            key, value = torch.cat([past[0], key], dim=-2), torch.cat([past[1], value], dim=-2)
        causal = query.shape[-2] > 1
        mixed = attend(query, key, value, causal).transpose(1, 2).flatten(2)  # [N, Q, inner]
        return self.to_out(mixed), (key, value) if keep else None

    def _one_query(self, x: torch.Tensor, place: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The query of one token [N, heads, 1, dim_head], and keys and values of all T."""
        weight, bias = self.to_qkv.weight, self.to_qkv.bias
        split = (None, None) if bias is None else (bias[: self.inner], bias[self.inner :])
        token = x[:, place].contiguous()  # [N, C]; torch multiplies a strided 3-D input row by row
        query = self._heads(F.linear(token, weight[: self.inner], split[0]).unsqueeze(1), 1)
        key, value = self._heads(F.linear(x, weight[self.inner :], split[1]), 2).unbind(0)
        return query[0], key, value

    def _heads(self, x: torch.Tensor, parts: int) -> torch.Tensor:
        """[N, T, parts * inner] -> [parts, N, heads, T, dim_head]."""
        return x.unflatten(-1, (parts, self.heads, -1)).permute(2, 0, 3, 1, 4)


class FeedForward(nn.Sequential):
    """Two linear layers with an exact GELU between them, [..., C] -> [..., C]."""

    def __init__(self, dim: int, hidden: int, dropout: float = 0.0) -> None:
        super().__init__(
            nn.Linear(dim, hidden), nn.GELU(), nn.Dropout(dropout), nn.Linear(hidden, dim), nn.Dropout(dropout)
        )


class Block(nn.Module):
    """Pre-norm transformer block, [N, T, C] -> [N, T, C].

    Args:
        dim (int): C.
        heads (int): number of attention heads, each C / heads wide.
        mlp_dim (int): hidden width of the feed-forward layer.
        eps (float, optional): of the layer norms. Default: ``1e-12``.
        causal (bool, optional): each token attends to itself and earlier tokens only. Default: ``False``.
    """

    def __init__(self, dim: int, heads: int, mlp_dim: int, eps: float = 1e-12, *, causal: bool = False) -> None:
        super().__init__()
        self.attn_norm = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, dim // heads, causal=causal, qkv_bias=True)
        self.mlp_norm = nn.LayerNorm(dim, eps=eps)
        self.mlp = FeedForward(dim, mlp_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, T, C] -> [N, T, C]."""
        # Under autocast, branches are cast to float32 first: torch adds tensors of two dtypes at half the speed.
        x = x + self.attn(self.attn_norm(x)).to(x.dtype)
        return x + self.mlp(self.mlp_norm(x)).to(x.dtype)

    def first(self, x: torch.Tensor) -> torch.Tensor:
        """Only the first token of :meth:`forward`, for a block that is not causal: [N, T, C] -> [N, 1, C]."""
        token = x[:, :1] + self.attn.first(self.attn_norm(x))
        return token + self.mlp(self.mlp_norm(token))


class AdaptiveBlock(nn.Module):
    """Causal block whose normalisation is shifted, scaled and gated by a condition (AdaLN-zero, arXiv 2212.09748).

    The modulation layer is initialised to zero, so the block starts as the identity. The modulation depends on the
    condition only: a rollout computes it once and reuses it while the tokens change.

    Args:
        dim (int): C.
        heads (int): number of attention heads.
        dim_head (int): width of a head.
        mlp_dim (int): hidden width of the feed-forward layer.
        dropout (float): dropout rate of both branches.
        weight_dropout (float, optional): dropout rate of the attention weights. Default: ``0.0``.
    """

    def __init__(
        self, dim: int, heads: int, dim_head: int, mlp_dim: int, dropout: float, weight_dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.adaptive_norm = nn.LayerNorm(dim, eps=1e-6, elementwise_affine=False)
        self.to_modulation = nn.Linear(dim, 6 * dim)
        self.attn_norm = nn.LayerNorm(dim)
        self.attn = Attention(
            dim, heads, dim_head, causal=True, qkv_bias=False, dropout=dropout, weight_dropout=weight_dropout
        )
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = FeedForward(dim, mlp_dim, dropout)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Sets the modulation layer to zero; the other layers have their own ``reset_parameters``."""
        nn.init.zeros_(self.to_modulation.weight)
        nn.init.zeros_(self.to_modulation.bias)

    def modulation(self, condition: torch.Tensor) -> torch.Tensor:
        """Condition [N, T, C] -> shift, scale and gate of both branches [N, T, 6C]."""
        return self.to_modulation(F.silu(condition))

    def forward(self, x: torch.Tensor, modulation: torch.Tensor) -> torch.Tensor:
        """Tokens [N, T, C] and modulation [N, T, 6C] -> [N, T, C]."""
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = modulation.chunk(6, dim=-1)  # each [N, T, C]
        x = x + gate_a * self.attn(self.attn_norm(self.adaptive_norm(x) * (1 + scale_a) + shift_a))
        return x + gate_m * self.mlp(self.mlp_norm(self.adaptive_norm(x) * (1 + scale_m) + shift_m))

    def extend(
        self, x: torch.Tensor, modulation: torch.Tensor, past: Cache | None, *, last: bool, keep: bool
    ) -> tuple[torch.Tensor, Cache | None]:
        """As :meth:`forward` without dropout, for new tokens after cached ones; see :meth:`Attention.extend`."""
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = modulation.chunk(6, dim=-1)  # each [N, T, C]
        hidden = self.attn_norm(_modulate(self.adaptive_norm(x), shift_a, scale_a))
        mixed, seen = self.attn.extend(hidden, past, last=last, keep=keep)
        if last and x.shape[-2] > 1:
            x, gate_a, shift_m, scale_m, gate_m = (t[:, -1:].contiguous() for t in (x, gate_a, shift_m, scale_m, gate_m))
        x = torch.addcmul(x, gate_a, mixed)
        hidden = self.mlp(self.mlp_norm(_modulate(self.adaptive_norm(x), shift_m, scale_m)))
        return torch.addcmul(x, gate_m, hidden), seen


def _modulate(x: torch.Tensor, shift: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Tokens x (1 + scale) + shift, all [N, T, C], in two passes over memory."""
    return torch.addcmul(x + shift, x, scale)


def checkpoint_activations(*networks: nn.Module, enabled: bool = True) -> None:
    """Switches activation checkpointing of every transformer inside the networks on or off.

    Only the inputs of each block are kept for the backward pass, which recomputes the rest: the gradients are the same
    to the last bit, dropout included, at the cost of one more forward pass. Call it before a loss is built from the
    networks.

    Args:
        *networks (nn.Module): an encoder, a predictor or a world model.
        enabled (bool, optional): on or off. Default: ``True``.

    Raises:
        ValueError: the networks contain no transformer.

    Examples:
        >>> from torchrl_ficreg import ViTEncoder
        >>> encoder = ViTEncoder(image_size=28, depth=2)
        >>> checkpoint_activations(encoder)
        >>> encoder.module.checkpointing
        True
    """
    found = [part for network in networks for part in network.modules() if hasattr(part, "checkpointing")]
    if not found:
        raise ValueError("these networks have no transformer blocks: activation checkpointing needs a transformer.")
    for part in found:
        part.checkpointing = enabled


def run_block(block: nn.Module, *inputs: torch.Tensor, checkpointing: bool) -> torch.Tensor:
    """``block(*inputs)``; with ``checkpointing``, its activations are recomputed in the backward pass."""
    if not (checkpointing and torch.is_grad_enabled()):
        return block(*inputs)
    # At the time of the backward pass, a functional loss has removed its parameters from the module.
    tensors = {**dict(block.named_parameters()), **dict(block.named_buffers())}
    return checkpoint(lambda *x: functional_call(block, tensors, x), *inputs, use_reentrant=False)
