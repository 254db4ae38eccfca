"""Claims about the predictor: causal, blind to actions at first, a modulation that can be computed ahead."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_ficreg import ActionEncoder, CausalPredictor

SIZES = {"latent_dim": 6, "action_dim": 4, "history": 3}
SIZES |= {"width": 8, "depth": 2, "heads": 2, "dim_head": 4, "mlp_dim": 16}


@pytest.fixture
def predictor(tiny_world):
    return tiny_world().predictor


@pytest.mark.parametrize("changed", ["latent", "action"])
@pytest.mark.parametrize("at", [0, 1, 2])
def test_the_future_does_not_change_the_past(predictor, changed, at):
    """Row t depends on latents and action blocks up to t, and on each of them."""
    given = {"latent": torch.randn(2, 3, 6), "action": torch.randn(2, 3, 4)}
    before = predictor(**given)
    given[changed] = given[changed].clone()
    given[changed][:, at] += 1.0
    after = predictor(**given)
    torch.testing.assert_close(after[:, :at], before[:, :at], rtol=0, atol=0)
    for row in range(at, 3):
        assert (after[:, row] - before[:, row]).abs().max() > 1e-4


def test_at_the_start_the_action_has_no_influence():
    """AdaLN-zero: training decides how much the action matters."""
    predictor = CausalPredictor(**SIZES).eval()
    latent = torch.randn(2, 3, 6)
    moved = predictor(latent=latent, action=torch.randn(2, 3, 4))
    assert moved.equal(predictor(latent=latent, action=torch.zeros(2, 3, 4)))


@pytest.mark.parametrize("lead", [(), (5,), (2, 3)])
@pytest.mark.parametrize("tokens", [1, 2, 3])
def test_leading_dimensions_are_rows(predictor, lead, tokens):
    latent, action = torch.randn(*lead, tokens, 6), torch.randn(*lead, tokens, 4)
    result = predictor(latent=latent, action=action)
    assert result.shape == latent.shape
    flat = predictor(latent=latent.reshape(-1, tokens, 6), action=action.reshape(-1, tokens, 4))
    torch.testing.assert_close(result, flat.reshape(latent.shape))


@pytest.mark.parametrize(
    ("layer", "context", "expected"),
    [(0, 1, [1, 1, 1, 3, 3, 3]), (0, 2, [2, 1, 3, 3, 3, 3]), (0, 3, [3] * 6), (0, 4, [3] * 6), (-1, 1, [1] * 6)],
)
def test_imagining_computes_each_token_of_a_growing_window_once_and_the_last_layer_the_last_alone(
    predictor, layer, context, expected
):
    """Six blocks from C frames on: one token a step until the window of three slides, then all three."""
    tokens = []
    predictor.module.blocks[layer].mlp.register_forward_pre_hook(lambda _, x: tokens.append(x[0].shape[1]))
    imagined = predictor.module.rollout(torch.randn(2, context, 6), torch.randn(2, context + 5, 4))
    assert imagined.shape == (2, 6, 6) and tokens == expected


def test_keys_can_be_renamed_nested_too(predictor):
    renamed = CausalPredictor(**SIZES, projector_dim=12, in_keys=(("a", "z"), "u"), out_key=("next", "z")).eval()
    renamed.load_state_dict(predictor.state_dict())
    latent, action = torch.randn(2, 3, 6), torch.randn(2, 3, 4)
    output = renamed(TensorDict({("a", "z"): latent, "u": action}, [2]))
    assert output["next", "z"].equal(predictor(latent=latent, action=action))


def test_the_action_embedding_is_two_layers_after_a_bottleneck():
    module = ActionEncoder(action_dim=4, width=8, bottleneck=3, in_key=("agent", "u"), out_key="e")
    net, action = module.module, torch.randn(5, 4)
    hidden = net.layer_in(net.compress(action))
    torch.testing.assert_close(
        module(TensorDict({("agent", "u"): action}, [5]))["e"], net.layer_out(hidden * hidden.sigmoid())
    )


@pytest.mark.parametrize(
    ("latent", "action", "message"),
    [
        ((2, 4, 6), (2, 4, 4), "takes 1 to 3 latents, got 4"),
        ((2, 0, 6), (2, 0, 4), "takes 1 to 3 latents, got 0"),
        ((2, 3, 5), (2, 3, 4), "latents must be 6 wide, got 5"),
        ((2, 3, 6), (2, 3, 2), "action blocks must be 4 wide .* got 2"),
    ],
)
def test_wrong_inputs_are_refused(predictor, latent, action, message):
    with pytest.raises(ValueError, match=message):
        predictor(latent=torch.zeros(latent), action=torch.zeros(action))
