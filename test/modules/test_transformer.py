"""Claims about attention and AdaLN-zero: the shortcuts change nothing, blocks start as the identity."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from torchrl_ficreg import ViTEncoder
from torchrl_ficreg.modules.transformer import AdaptiveBlock, attend, attend_by_products, Attention, Block, FeedForward


@pytest.mark.parametrize("way", [attend, attend_by_products])
@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("tokens", [1, 3, 17])
def test_attend_is_scaled_dot_product_attention(causal, tokens, way):
    """In value and gradient."""
    inputs = [torch.randn(2, 3, tokens, 8, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    ours = way(*inputs, causal)
    theirs = F.scaled_dot_product_attention(*inputs, is_causal=causal)
    torch.testing.assert_close(ours, theirs)
    gradients = (torch.autograd.grad(value, inputs, torch.ones_like(value).cumsum(-1)) for value in (ours, theirs))
    torch.testing.assert_close(*gradients)


def test_attend_keeps_bfloat16():
    inputs = [torch.randn(2, 3, 5, 8) for _ in range(3)]
    result = attend(*(value.bfloat16() for value in inputs), True)
    assert result.dtype == torch.bfloat16
    torch.testing.assert_close(result.float(), attend(*inputs, True), rtol=0.1, atol=0.05)


@pytest.mark.parametrize("tokens", [3, 17])
@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("qkv_bias", [False, True])
def test_shortcuts_of_attention_lead_to_the_same_place(causal, qkv_bias, tokens):
    """One token, which is the first of several causal ones by the general path; few tokens without gradients."""
    attention = Attention(12, 2, 5, causal=True, qkv_bias=qkv_bias).double()
    x = torch.randn(4, tokens, 12, dtype=torch.float64)
    expected = attention(x)
    with torch.no_grad():
        torch.testing.assert_close(attention(x), expected)
    attention.causal = causal
    torch.testing.assert_close(attention(x[:, :1]), expected[:, :1])


def test_a_vision_block_treats_tokens_as_a_set():
    block, x, order = Block(8, 2, 16).double(), torch.randn(2, 5, 8, dtype=torch.float64), torch.randperm(5)
    torch.testing.assert_close(block(x[:, order]), block(x)[:, order])


def test_an_adaptive_block_starts_as_the_identity_and_learns_from_the_first_step():
    """AdaLN-zero: the gates are zero whatever the condition, so tokens pass bit for bit; gradient reaches them at once."""
    block, x = AdaptiveBlock(8, 2, 4, 16, dropout=0.1), torch.randn(2, 3, 8)
    modulation = block.modulation(torch.randn(2, 3, 8))
    assert modulation.shape == (2, 3, 48) and (modulation == 0).all()
    output = block(x, modulation)
    assert output.equal(x)
    output.square().sum().backward()
    gate = block.to_modulation.weight.grad.unflatten(0, (6, 8)).flatten(1).norm(dim=1)
    assert gate[2] > 0 and gate[5] > 0


def test_shift_scale_and_gate_are_those_of_the_paper():
    """Each branch is x + gate * branch(norm(x) * (1 + scale) + shift), written out."""
    block = AdaptiveBlock(8, 2, 4, 16, dropout=0.0).double()
    x, modulation = torch.randn(2, 3, 8).double(), torch.randn(2, 3, 48).double()
    shift, scale, gate, shift_mlp, scale_mlp, gate_mlp = modulation.split(8, -1)

    def norm(y):
        return (y - y.mean(-1, keepdim=True)) / (y.var(-1, keepdim=True, correction=0) + 1e-6).sqrt()

    expected = x + gate * block.attn(block.attn_norm(norm(x) * (1 + scale) + shift))
    expected = expected + gate_mlp * block.mlp(block.mlp_norm(norm(expected) * (1 + scale_mlp) + shift_mlp))
    torch.testing.assert_close(block(x, modulation), expected)


def test_the_feed_forward_layer_uses_the_exact_gelu():
    layer, x = FeedForward(4, 8).double(), torch.randn(3, 4).double()
    hidden = layer[0](x)
    torch.testing.assert_close(layer(x), layer[3](hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5))))


def test_attention_weights_are_dropped_in_training_alone():
    """With a share of 0.5, weights are 0 or twice their value; the mean over many draws is the output of eval mode."""
    torch.manual_seed(0)
    attention = Attention(8, 2, 4, causal=True, qkv_bias=False, weight_dropout=0.5)
    x = torch.randn(1, 3, 8)
    expected = attention.eval()(x)
    assert attention(x).equal(expected)
    draws = attention.train()(x.expand(4000, -1, -1))
    assert not draws[0].equal(draws[1])
    torch.testing.assert_close(draws.mean(0, keepdim=True), expected, rtol=0, atol=0.05)


def vision_transformer():
    return ViTEncoder(image_size=16, patch_size=4, width=12, depth=2, heads=3, mlp_dim=16, projector_dim=12)


@pytest.mark.parametrize(("training", "dtype"), [(True, None), (False, torch.bfloat16)])
def test_a_vision_transformer_compiles_into_one_graph(training, dtype):
    encoder, pixels = vision_transformer().train(training), torch.randint(0, 256, (4, 3, 16, 16), dtype=torch.uint8)
    with torch.autocast("cpu", dtype, enabled=dtype is not None):
        latent = torch.compile(encoder.module, backend="eager", fullgraph=True)(pixels)
    assert latent.shape == (4, 192) and latent.isfinite().all()


@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_transforms_of_torch_func_see_through_a_block(dtype):
    """``vmap`` is the loop over its dimension; per-sample gradients add up to the gradient of the batch."""
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
    """With gradients, its latents are those without."""
    encoder, pixels = vision_transformer().eval(), torch.randint(0, 256, (3, 3, 16, 16), dtype=torch.uint8)
    with torch.no_grad():
        expected = encoder(pixels=pixels)
    torch.testing.assert_close(encoder(pixels=pixels), expected)
