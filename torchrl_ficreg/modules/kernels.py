"""Linear layers and attention whose training step is cheap on CPUs: same numbers, fewer passes over memory.

Where torch's own kernels are as fast, these step aside: on GPUs, while ``torch.compile`` traces, for inference in float32,
and, for linear layers, on processors without AMX; and inside ``torch.func``, which cannot look into them. Shapes: N sequences, T tokens, C channels.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from torch import nn
from torch.autograd.function import once_differentiable

from torchrl_ficreg._device import has_amx

MANY = 1024  # rows from which the sum over them, for the gradient of a bias, is worth a matrix product
CACHED = 4 * 2**20  # bytes of attention weights worked on at once: more do not stay in the cache


def trains_on_cpu(x: torch.Tensor) -> bool:
    """Whether gradients will be wanted of what is computed from x, on a CPU, where these kernels can be called."""
    return x.device.type == "cpu" and torch.is_grad_enabled() and not _transformed()


def _transformed() -> bool:
    """Whether ``torch.compile`` or a transform of ``torch.func`` is at work: both need torch's own operators."""
    return torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()


def suits_packed_attention(packed: torch.Tensor) -> bool:
    """Whether :func:`packed_attention` is the fastest: on CPUs, in training and in bfloat16."""
    on_cpu = packed.device.type == "cpu" and not _transformed()
    return on_cpu and (torch.is_grad_enabled() or packed.dtype == torch.bfloat16)


def linear(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
    """``F.linear``, cheaper in training on CPUs with AMX under autocast: [..., C] -> [..., out].

    torch copies the bias to every row before a product, and sums the rows of a bfloat16 gradient at a third of the
    speed at which a product with a row of ones does; both sums are made in float32. Without AMX the products take so
    long that nothing is gained.

    Args:
        x: [..., C].
        weight: [out, C].
        bias: [out], or None.
    """
    fits = bias is not None and weight.requires_grad and x.numel() >= MANY * x.shape[-1]
    if fits and trains_on_cpu(x) and torch.is_autocast_enabled("cpu") and has_amx():
        return _Linear.apply(x, weight, bias, torch.get_autocast_dtype("cpu"))
    return F.linear(x, weight, bias)


class Linear(nn.Linear):
    """``nn.Linear`` by way of :func:`linear`."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[..., in_features] -> [..., out_features]."""
        return linear(x, self.weight, self.bias)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        ctx.wide = x.dtype, weight.dtype, bias.dtype
        x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
        ctx.save_for_backward(x, weight)
        if dtype == torch.bfloat16 and _adds_bias_in_product():
            return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
        return F.linear(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        rows = grad.flatten(0, -2)  # [R, out]
        for_x = (rows @ weight).view_as(x).to(ctx.wide[0]) if ctx.needs_input_grad[0] else None
        for_weight, for_bias = _sums_over_rows(rows, x.flatten(0, -2))
        for_weight = for_weight.to(ctx.wide[1], memory_format=torch.contiguous_format)
        return for_x, for_weight, for_bias.to(ctx.wide[2]), None


def _sums_over_rows(grad: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of weight [out, C] and bias [out] from those of the output [R, out] and the input [R, C]."""
    width = x.shape[1]
    if width >= grad.shape[1]:
        return grad.t() @ x, (grad.new_ones(1, len(grad)) @ grad)[0]
    # A product with the identity transposes a narrow input, exactly and several times faster than a copy does; one
    # more row, of ones, sums the gradient for the bias in the same pass over it.
    columns = torch.eye(width + 1, width, dtype=x.dtype, device=x.device) @ x.t()  # [C + 1, R]
    columns[width] = 1
    sums = columns @ grad  # [C + 1, out]
    return sums[:width].t(), sums[width]


@cache
def _adds_bias_in_product() -> bool:
    """Whether torch has the operator its own compiler uses for bfloat16 layers, and this processor can run it."""
    known = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    return known and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def packed_attention(packed: torch.Tensor, heads: int) -> torch.Tensor:
    """Softmax attention of every token to all, from one tensor and with one gradient for it.

    The scores of a few heads at a time pass from the first matrix product through the softmax to the second while
    they are in the cache. The backward pass works the same way, where ``scaled_dot_product_attention`` computes the
    scores again.

    Args:
        packed: queries, keys and values side by side [N, T, 3 * heads * dim_head], any floating dtype, on a CPU.
        heads: number of heads.

    Returns:
        [N, T, heads * dim_head]; differentiable once.
    """
    return _PackedAttention.apply(packed, heads)


class _PackedAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, packed: torch.Tensor, heads: int) -> torch.Tensor:
        (num, tokens, width), ctx.heads = packed.shape, heads
        dim_head = width // (3 * heads)  # a -1 would not do for N = 0
        split = packed.view(num, tokens, 3, heads, dim_head).permute(2, 0, 3, 1, 4)  # [3, N, heads, T, dim_head]
        split = split.reshape(3, num * heads, tokens, dim_head)  # [3, R, T, dim_head] for R heads of all sequences
        weights = packed.new_empty(num * heads, tokens, tokens)
        mixed = torch.empty_like(split[0])
        scale = split.shape[-1] ** -0.5
        for query, key, value, weight, out in _parts(weights, *split, weights, mixed):
            scores = torch.baddbmm(weight, query, key.transpose(1, 2), beta=0, alpha=scale)
            torch.softmax(scores, -1, out=weight)
            torch.bmm(weight, value, out=out)
        ctx.save_for_backward(split, weights)
        return mixed.view(num, heads, tokens, dim_head).transpose(1, 2).reshape(num, tokens, width // 3)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        split, weights = ctx.saved_tensors
        num, tokens, width = grad.shape
        grad = grad.view(num, tokens, ctx.heads, width // ctx.heads).transpose(1, 2).reshape(split.shape[1:])  # [R, T, dim_head]
        grads = torch.empty_like(split)
        scale = split.shape[-1] ** -0.5
        for query, key, value, weight, above, for_query, for_key, for_value in _parts(
            weights, *split, weights, grad, *grads
        ):
            torch.bmm(weight.transpose(1, 2), above, out=for_value)
            slope = torch.bmm(above, value.transpose(1, 2))
            slope = torch._softmax_backward_data(slope, weight, -1, weight.dtype)
            torch.baddbmm(for_query, slope, key, beta=0, alpha=scale, out=for_query)
            torch.baddbmm(for_key, slope.transpose(1, 2), query, beta=0, alpha=scale, out=for_key)
        grads = grads.view(3, num, ctx.heads, tokens, width // ctx.heads).permute(1, 3, 0, 2, 4)  # [N, T, 3, heads, dim_head]
        return grads.reshape(num, tokens, 3 * width), None


def _parts(weights: torch.Tensor, *tensors: torch.Tensor) -> zip[tuple[torch.Tensor, ...]]:
    """Cuts tensors [R, ...] alike, so that the part of the attention weights [R, T, T] fits the cache."""
    count = max(1, -(-weights.numel() * weights.element_size() // CACHED))
    return zip(*(tensor.chunk(count) for tensor in tensors))
