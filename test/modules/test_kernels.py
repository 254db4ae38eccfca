"""Claims about the kernels for training on CPUs: they are ``F.linear`` and softmax attention, in value and gradient."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F

from torchrl_ficreg import ViTEncoder
from torchrl_ficreg.modules import kernels
from torchrl_ficreg.modules.kernels import Linear, packed_attention
from torchrl_ficreg.modules.transformer import Block


def plain_attention(packed, heads):
    parts = (part.unflatten(-1, (heads, -1)).transpose(1, 2) for part in packed.chunk(3, dim=-1))
    return F.scaled_dot_product_attention(*parts).transpose(1, 2).flatten(2)


def value_and_gradient(call, x):
    result = call(x)
    return result, *torch.autograd.grad(result, x, torch.ones_like(result).cumsum(-1))


@pytest.mark.parametrize("cached", [1, 2000, kernels.CACHED])
def test_packed_attention_is_scaled_dot_product_attention(monkeypatch, cached):
    """Head by head, in uneven parts, or all at once."""
    monkeypatch.setattr(kernels, "CACHED", cached)
    packed = torch.randn(5, 7, 3 * 3 * 4, dtype=torch.float64, requires_grad=True)
    ours = value_and_gradient(lambda x: packed_attention(x, 3), packed)
    torch.testing.assert_close(ours, value_and_gradient(lambda x: plain_attention(x, 3), packed))


def test_packed_attention_has_the_gradient_of_its_differences():
    packed = torch.randn(2, 3, 3 * 2 * 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: packed_attention(x, 2), packed)


def test_packed_attention_reads_any_strides_and_leaves_its_input():
    packed = torch.randn(24, 7, 3, dtype=torch.float64).permute(2, 1, 0)  # [N, T, 3 * heads * dim_head]
    before = packed.clone()
    torch.testing.assert_close(packed_attention(packed, 2), plain_attention(packed, 2))
    assert packed.equal(before)


def under_autocast(layer, x):
    with torch.autocast("cpu", torch.bfloat16):
        result = layer(x)
    gradients = torch.autograd.grad(result, [x, *layer.parameters()], torch.ones_like(result).cumsum(-1) / 10)
    return result, *gradients


@pytest.mark.parametrize("lead", [(2048,), (4, 512), (3,)])
@pytest.mark.parametrize("width, out", [(24, 16), (16, 24), (16, 16)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_linear_layer_is_that_of_torch_to_bfloat16(lead, width, out, dtype):
    """Values, and gradients in the dtypes of what they belong to, of many rows and of few."""
    ours, x = Linear(width, out), torch.randn(*lead, width, dtype=dtype, requires_grad=True)
    theirs = torch.nn.Linear(width, out)
    theirs.load_state_dict(ours.state_dict())
    for mine, other in zip(under_autocast(ours, x), under_autocast(theirs, x)):
        assert mine.dtype == other.dtype
        torch.testing.assert_close(mine, other, rtol=1e-2, atol=1e-2 * other.abs().max().item())


@pytest.mark.parametrize("width, out", [(2, 3), (3, 2)])
def test_the_gradient_of_a_bias_is_summed_in_float32(width, out):
    """A sum kept in bfloat16 would stop growing at 256."""
    layer, x = Linear(width, out), torch.zeros(5000, width)
    with torch.autocast("cpu", torch.bfloat16):
        layer(x).sum().backward()
    assert (layer.bias.grad - 5000).abs().max() <= 8  # half of what one bit of bfloat16 is worth there


@pytest.mark.parametrize("requires_grad", [True, False])
def test_without_many_rows_autocast_or_gradients_a_linear_layer_is_torchs_own(requires_grad):
    layer, x = Linear(4, 3).requires_grad_(requires_grad), torch.randn(2000, 4)
    assert layer(x).equal(F.linear(x, layer.weight, layer.bias))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        assert layer(x).equal(F.linear(x, layer.weight, layer.bias))


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_a_vision_transformer_compiles_into_one_graph_for_many_rows(training, dtype):
    """No question about the processor is asked while the compiler traces."""
    encoder = ViTEncoder(image_size=16, patch_size=4, width=12, depth=2, heads=3, mlp_dim=16, projector_dim=12).train(training)
    pixels = torch.randint(0, 256, (kernels.MANY // 16, 3, 16, 16), dtype=torch.uint8)
    with torch.autocast("cpu", dtype, enabled=dtype is not None):
        latent = torch.compile(encoder.module, backend="eager", fullgraph=True)(pixels)
        assert latent.shape == (len(pixels), 192) and latent.isfinite().all()


@pytest.mark.parametrize("amx", [True, False])
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_transforms_of_torch_func_see_through_a_vision_transformer(monkeypatch, amx, dtype):
    """``vmap`` is the loop over its dimension; per-sample gradients add up to the gradient of the batch."""
    monkeypatch.setattr(kernels, "has_amx", lambda: amx)
    monkeypatch.setattr(kernels, "MANY", 1)
    block = Block(12, 3, 16)
    x, params = torch.randn(5, 4, 12), dict(block.named_parameters())

    def objective(params, x):
        return torch.func.functional_call(block, params, (x,)).float().square().sum()

    with torch.autocast("cpu", dtype, enabled=dtype is not None):
        expected = torch.func.grad(objective)(params, x)
        found = torch.vmap(torch.func.grad(objective), (None, 0))(params, x.unsqueeze(1))
        mapped = torch.vmap(block)(x.unsqueeze(1)).squeeze(1)
        whole = block(x)
    tolerance = 1e-5 if dtype is None else 5e-2
    for name, gradient in expected.items():
        scale = gradient.abs().max().item()
        torch.testing.assert_close(found[name].sum(0), gradient, rtol=0, atol=tolerance * max(scale, 1))
    torch.testing.assert_close(mapped, whole, rtol=0, atol=tolerance * whole.abs().max().item())


def test_the_first_token_of_a_block_costs_less_and_is_the_same():
    """In value, and in every gradient."""
    block = Block(12, 3, 16).double()
    x = torch.randn(4, 9, 12, dtype=torch.float64, requires_grad=True)
    results = []
    for call in (block.first, lambda tokens: block(tokens)[:, :1]):
        result = call(x)
        weight = torch.ones_like(result).cumsum(-1)
        results.append((result, *torch.autograd.grad(result, [x, *block.parameters()], weight)))
    torch.testing.assert_close(*results)


def test_a_vision_transformer_trains_as_it_infers():
    """With kernels of its own for training, its latents are those of evaluation, and a copy learns the same."""
    encoder = ViTEncoder(image_size=16, patch_size=8, width=12, depth=2, heads=3, mlp_dim=16, projector_dim=12).eval()
    other, pixels = copy.deepcopy(encoder), torch.randint(0, 256, (3, 3, 16, 16), dtype=torch.uint8)
    with torch.no_grad():
        expected = encoder(pixels=pixels)
    torch.testing.assert_close(encoder(pixels=pixels), expected)
    for network in (encoder, other):
        network(pixels=pixels).square().sum().backward()
    assert all(mine.grad.equal(theirs.grad) for mine, theirs in zip(encoder.parameters(), other.parameters()))
