"""The only attention and adaptive-normalisation blocks of the package.

``Block`` is the pre-norm block of a vision transformer; ``AdaptiveBlock`` is the same with shift, scale and gate
given from outside (AdaLN-zero), as the predictor needs it. Shapes: N rows, T tokens, C channels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint

from torchrl_ficreg.modules.kernels import linear, Linear, packed_attention, suits_packed_attention


Cache = tuple[torch.Tensor, torch.Tensor]  # keys and values, each [N, heads, T, dim_head]


FEW = 4  # tokens up to which attention costs less by elementwise products than by matrix products, on CPUs


def attend(
    query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool, dropout: float = 0.0
) -> torch.Tensor:
    """Softmax attention by the kernel that is fastest on the device at hand.

    The fused kernel wins on GPUs, and on CPUs in float32 where no gradient is wanted. In training on CPUs, and in
    bfloat16, it costs up to three times two plain matrix products around a softmax; the windows of a few tokens that
    a planner imagines by the thousand are cheaper still without any matrix product.

    Args:
        query: [N, heads, Q, dim_head], any floating dtype.
        key, value: [N, heads, T, dim_head].
        causal: a token sees itself and earlier ones only; Q = T then.
        dropout: share of the attention weights dropped; 0 outside of training.

    Returns:
        [N, heads, Q, dim_head].
    """
    infers = not dropout and not (torch.is_grad_enabled() and query.requires_grad)
    on_cpu = query.device.type == "cpu"
    if on_cpu and infers and key.shape[-2] <= FEW:
        return _attend_to_few(query, key, value, causal)
    if not on_cpu or (infers and query.dtype == torch.float32):
        return F.scaled_dot_product_attention(query, key, value, is_causal=causal, dropout_p=dropout)
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)  # [N, heads, Q, T]
    if causal:
        tokens = scores.shape[-1]
        future = torch.ones(tokens, tokens, dtype=torch.bool, device=scores.device).triu(1)  # [T, T]
        scores = scores.masked_fill(future, -torch.inf)
    weights = scores.softmax(-1).to(value.dtype)
    return (F.dropout(weights, dropout) if dropout else weights) @ value


def _attend_to_few(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor, causal: bool) -> torch.Tensor:
    """As :func:`attend`, token by token: matrix products of a few rows spend their time on copies."""
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
    return torch.stack(mixed, dim=1).transpose(1, 2)  # in memory [N, Q, heads, dim_head], as the next layer reads it


class Attention(nn.Module):
    """Multi-head self-attention.

    Args:
        dim: channels C of the tokens.
        heads, dim_head: number and width of the heads.
        causal: a token sees itself and earlier ones only.
        qkv_bias: bias of the query, key and value projection.
        dropout: after the output projection.
        weight_dropout: of the attention weights.
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
        self.to_qkv = Linear(dim, 3 * self.inner, bias=qkv_bias)
        self.to_out = Linear(self.inner, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, T, C] -> [N, T, C]."""
        drop = self.weight_dropout if self.training else 0.0
        if x.shape[-2] == 1 and not drop:
            # One token attends to itself alone: the softmax is 1 whatever query and key are.
            bias = self.to_qkv.bias[2 * self.inner :] if self.to_qkv.bias is not None else None
            mixed = F.linear(x, self.to_qkv.weight[2 * self.inner :], bias)  # [N, 1, inner]
        else:
            packed = self.to_qkv(x)  # [N, T, 3 * inner]
            if suits_packed_attention(packed) and not self.causal and not drop:
                mixed = packed_attention(packed, self.heads)
            else:
                mixed = attend(*self._heads(packed, 3).unbind(0), self.causal, drop).transpose(1, 2).flatten(2)
        return self.dropout(self.to_out(mixed))  # of [N, T, inner]

    def first(self, x: torch.Tensor) -> torch.Tensor:
        """The first token of :meth:`forward` alone, where it sees all others: [N, T, C] -> [N, 1, C]."""
        mixed = attend(*self._one_query(x, 0), False).transpose(1, 2).flatten(2)  # [N, 1, inner]
        return self.dropout(self.to_out(mixed))

    def extend(
        self, x: torch.Tensor, past: Cache | None, *, last: bool, keep: bool
    ) -> tuple[torch.Tensor, Cache | None]:
        """Causal attention of new tokens whose predecessors' keys and values are known; no dropout.

        Args:
            x: [N, T, C]; T = 1 if there is a past.
            past: keys and values of the P earlier tokens, each [N, heads, P, dim_head].
            last: return the last token alone, at the cost of one token.
            keep: return the keys and values for a next call.

        Returns:
            [N, T, C], or [N, 1, C] if ``last``, and the keys and values of all P + T tokens, or None.
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
        token = x[:, place].contiguous()  # [N, C]; of a strided 3-D input, torch multiplies row by row
        query = self._heads(F.linear(token, weight[: self.inner], split[0]).unsqueeze(1), 1)
        key, value = self._heads(linear(x, weight[self.inner :], split[1]), 2).unbind(0)
        return query[0], key, value

    def _heads(self, x: torch.Tensor, parts: int) -> torch.Tensor:
        """[N, T, parts * inner] -> [parts, N, heads, T, dim_head]."""
        return x.unflatten(-1, (parts, self.heads, -1)).permute(2, 0, 3, 1, 4)


class FeedForward(nn.Sequential):
    """Two linear layers with an exact GELU between them, [..., C] -> [..., C]."""

    def __init__(self, dim: int, hidden: int, dropout: float = 0.0) -> None:
        super().__init__(
            Linear(dim, hidden), nn.GELU(), nn.Dropout(dropout), Linear(hidden, dim), nn.Dropout(dropout)
        )


class Block(nn.Module):
    """Pre-norm transformer block, [N, T, C] -> [N, T, C]; causal if asked to be."""

    def __init__(self, dim: int, heads: int, mlp_dim: int, eps: float = 1e-12, *, causal: bool = False) -> None:
        super().__init__()
        self.attn_norm = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, dim // heads, causal=causal, qkv_bias=True)
        self.mlp_norm = nn.LayerNorm(dim, eps=eps)
        self.mlp = FeedForward(dim, mlp_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, T, C] -> [N, T, C]."""
        # The branches are widened first under autocast: torch adds tensors of two dtypes at half the speed.
        x = x + self.attn(self.attn_norm(x)).to(x.dtype)
        return x + self.mlp(self.mlp_norm(x)).to(x.dtype)

    def first(self, x: torch.Tensor) -> torch.Tensor:
        """The first token of :meth:`forward` alone, where it sees all others: [N, T, C] -> [N, 1, C]."""
        token = x[:, :1] + self.attn.first(self.attn_norm(x))
        return token + self.mlp(self.mlp_norm(token))


class AdaptiveBlock(nn.Module):
    """Causal block whose normalisation is shifted, scaled and gated by a condition (AdaLN-zero, arXiv 2212.09748).

    The modulation layer starts at zero, so the block starts as the identity. It depends on the condition alone:
    :meth:`modulation` may be computed once and reused while the tokens change, as a planner does.
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
        """Zeroes the modulation; the other layers reset themselves."""
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
        """As :meth:`forward` without dropout, for new tokens after known ones; see :meth:`Attention.extend`."""
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
