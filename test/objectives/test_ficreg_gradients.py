"""Claims about gradients: every loss keeps its table, exact zeros included, and under FICReg the encoder learns as under LeWM."""

from __future__ import annotations

import pytest
import torch
from _losses import all_equal, call, COLLECTION, FICREG, gradients, make_clip, make_loss, make_networks, total
from tensordict.nn import TensorDictModule

from torchrl_ficreg import FICRegLoss, gradient_flow, InverseDynamicsModel, SIGReg
from torchrl_ficreg.modules.layers import GlobalBatchNorm1d

DETACHED = [name for name in FICREG if "live" not in name]


def autocast(precision: str) -> torch.autocast:
    return torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16")


# Which network receives gradient


@pytest.mark.parametrize(
    ("name", "precision", "reduction"),
    [
        *((name, precision, "mean") for name in COLLECTION for precision in ("fp32", "bf16")),
        *(("paper", "fp32", reduction) for reduction in ("sum", "none")),
    ],
)
def test_gradient_flow_is_the_table_of_the_loss(name, precision, reduction):
    """With exact zeros, in train mode, and without a trace in ``.grad``."""
    loss, table = make_loss(name, reduction=reduction), COLLECTION[name][3]
    with autocast(precision):
        flow = gradient_flow(loss, make_clip())
    assert {term: {network: norm != 0.0 for network, norm in row.items()} for term, row in flow.items()} == table
    assert all(param.grad is None for param in loss.parameters())


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("name", ["paper", "joint", "pldm"])
def test_plain_autograd_agrees(name, training):
    """In every norm. A network outside its row of the table is not even reached by the graph: its ``.grad`` stays None."""
    loss = make_loss(name, 0.0).train(training)
    flow = gradient_flow(loss, make_clip())
    for term, row in COLLECTION[name][3].items():
        for network, grads in gradients(loss, make_clip(), term).items():
            reached = [grad.flatten() for grad in grads if grad is not None]
            assert row[network] == bool(reached), (term, network)
            assert flow[term][network] == pytest.approx(torch.cat(reached).norm().item() if reached else 0.0, rel=1e-5)


def test_gradient_flow_reports_zeros_for_a_frozen_encoder():
    loss = make_loss("paper")
    loss.encoder_params.requires_grad_(False)
    flow = gradient_flow(loss, make_clip())
    assert [flow[term]["encoder"] for term in flow] == [0.0] * 4
    assert flow["loss_pred"]["predictor"] > 0 and flow["loss_consistency"]["predictor"] > 0


# The encoder, as under LeWM


@pytest.mark.parametrize(
    ("name", "seed", "precision"),
    [*((name, 0, "fp32") for name in DETACHED), *(("paper", seed, "bf16") for seed in (0, 1)), ("paper", 1, "fp32")],
)
def test_the_encoder_learns_exactly_as_under_lewm(name, seed, precision):
    """Not one bit of the encoder's gradient differs, with dropout and BatchNorm in train mode."""
    clip = make_clip(seed=seed)
    with autocast(precision):
        ours = gradients(make_loss(name, consistency_coeff=10.0, idm_coeff=10.0), clip)
        theirs = gradients(make_loss("lewm"), clip)
    assert all_equal(ours["encoder"], theirs["encoder"]) and not all_equal(ours["predictor"], theirs["predictor"])


def test_dropout_in_the_inverse_model_does_not_change_that():
    encoder, predictor, _ = make_networks()
    loss = FICRegLoss(encoder, predictor, InverseDynamicsModel(6, 6, 16, dropout=0.5), sigreg=SIGReg(16))
    ours, theirs = gradients(loss, make_clip()), gradients(make_loss("lewm"), make_clip())
    assert all_equal(ours["encoder"], theirs["encoder"])


@pytest.mark.parametrize("name", FICREG)
def test_without_mu_and_gamma_it_is_lewm_to_the_last_bit(name):
    """Values, and gradients of both networks."""
    losses = make_loss(name, consistency_coeff=0.0, idm_coeff=0.0), make_loss("lewm")
    ours, theirs = (call(loss, make_clip()) for loss in losses)
    assert ours["loss_idm"] == ours["loss_consistency"] == 0
    assert all(ours[term].equal(theirs[term]) for term in theirs.keys())
    ours, theirs = (gradients(loss, make_clip()) for loss in losses)
    assert all(all_equal(ours[network], theirs[network]) for network in ("encoder", "predictor"))


def test_running_statistics_move_once_a_step_and_as_under_lewm():
    losses = make_loss("paper"), make_loss("lewm")
    for loss in losses:
        total(call(loss, make_clip())).backward()
    for name in ("encoder", "predictor"):
        ours, theirs = (dict(getattr(loss, name).named_buffers()) for loss in losses)
        assert all(ours[key].equal(theirs[key]) for key in theirs)
        assert [value.item() for key, value in ours.items() if key.endswith("num_batches_tracked")] == [1]


# The frozen inverse model


@pytest.mark.parametrize("name", FICREG)
def test_the_consistency_term_does_not_change_the_inverse_model(name):
    """Bit for bit, parameters and buffers, after a step of an optimiser with weight decay."""
    loss = make_loss(name)
    before = {key: value.clone() for key, value in loss.inverse_model_params.flatten_keys().items()}
    optimizer = torch.optim.AdamW(loss.parameters(), lr=0.1)
    found = gradients(loss, make_clip(), "loss_consistency")["inverse_model"]
    optimizer.step()
    assert all(grad is None for grad in found)
    assert all(value.equal(before[key]) for key, value in loss.inverse_model_params.flatten_keys().items())
    assert all(param.requires_grad for param in loss.inverse_model.parameters())


def test_the_frozen_inverse_model_has_the_current_weights():
    """Frozen means without gradient, not out of date: new weights count at once, however they were assigned."""
    loss, clip = make_loss("paper").eval(), make_clip()
    start, bias = loss(clip)["loss_consistency"], loss.inverse_model.module.layers[-1].bias
    with torch.no_grad():
        bias.add_(1.0)
    in_place = loss(clip)["loss_consistency"]
    bias.data = bias.data - 1.0  # as torch.nn.utils.vector_to_parameters does
    assert in_place > start
    torch.testing.assert_close(loss(clip)["loss_consistency"], start)


class _NormedInverse(torch.nn.Module):
    def __init__(self, norm):
        super().__init__()
        self.norm, self.out = norm(12), torch.nn.Linear(12, 6)

    def forward(self, before, after):
        pairs = torch.cat([before, after], -1)
        return self.out(self.norm(pairs.flatten(0, -2))).unflatten(0, pairs.shape[:-1])


@pytest.mark.parametrize("norm", [torch.nn.BatchNorm1d, GlobalBatchNorm1d])
@pytest.mark.parametrize("name", ["paper", "live", "two_steps_live", "joint", "pldm"])
def test_batch_norm_of_an_inverse_model_has_the_statistics_of_real_transitions(name, norm):
    """They move once a step, in a loss that applies the inverse model to predictions too."""
    make, arguments, *_ = COLLECTION[name]
    encoder, predictor, _ = make_networks()
    inverse = TensorDictModule(_NormedInverse(norm), ["before", "after"], ["recovered_action"])
    loss, clip = make(encoder, predictor, inverse, **arguments), make_clip()
    latent = loss.peek(clip).transpose(0, 1)  # [B, T, D]
    total(loss(clip)).backward()
    assert inverse.module.norm.num_batches_tracked == 1
    mean = torch.cat([latent[:, :-1], latent[:, 1:]], -1).mean((0, 1))
    torch.testing.assert_close(inverse.module.norm.running_mean, 0.1 * mean)
