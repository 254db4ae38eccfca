"""Claims about who receives gradient: the table of FICReg, exact zeros, and an encoder that learns as under LeWM."""

from __future__ import annotations

import contextlib

import pytest
import torch

from torchrl_ficreg import gradient_flow

TABLE = {
    "loss_pred": {"encoder": True, "predictor": True, "inverse_model": False},
    "loss_sigreg": {"encoder": True, "predictor": False, "inverse_model": False},
    "loss_idm": {"encoder": False, "predictor": False, "inverse_model": True},
    "loss_consistency": {"encoder": False, "predictor": True, "inverse_model": False},
}
NETWORKS = ("encoder", "predictor", "inverse_model")
PRECISIONS = {"fp32": contextlib.nullcontext, "bf16": lambda: torch.autocast("cpu", torch.bfloat16)}


def step(loss, clip, seed=3, precision="fp32", terms=None):
    """Gradients of the sum of the terms (all of them by default), without touching a parameter."""
    loss.zero_grad()
    loss.sigreg.generator_state[1] = 0
    torch.manual_seed(seed)
    with PRECISIONS[precision]():
        output = loss(clip)
    sum(value.sum() for key, value in output.items() if terms is None or key in terms).backward()
    return {name: [param.grad for param in getattr(loss, name).parameters()] for name in loss._networks}


def norm(gradients):
    return sum(float(grad.norm()) for grad in gradients if grad is not None)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_gradient_flow_is_the_table(make_ficreg, make_clip, precision, reduction):
    loss = make_ficreg(reduction=reduction)
    with PRECISIONS[precision]():
        flow = gradient_flow(loss, make_clip())
    assert {term: {name: value > 0 for name, value in row.items()} for term, row in flow.items()} == TABLE
    assert all(value == 0.0 for term, row in flow.items() for name, value in row.items() if not TABLE[term][name])
    assert all(param.grad is None for param in loss.parameters())


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("term", TABLE)
def test_plain_autograd_says_the_same(make_ficreg, make_clip, term, training):
    """A network outside its row of the table is not even reached by the graph: its ``.grad`` stays None."""
    gradients = step(make_ficreg().train(training), make_clip(), terms=[term])
    for name, expected in TABLE[term].items():
        assert (norm(gradients[name]) > 0) == expected, name
        if not expected:
            assert all(grad is None for grad in gradients[name]), name


def test_lewm_has_the_first_two_rows(make_lewm, make_clip):
    flow = gradient_flow(make_lewm(), make_clip())
    assert {term: {name: value > 0 for name, value in row.items()} for term, row in flow.items()} == {
        "loss_pred": {"encoder": True, "predictor": True},
        "loss_sigreg": {"encoder": True, "predictor": False},
    }


def test_gradient_flow_measures_the_norms_of_autograd(make_ficreg, make_clip):
    loss = make_ficreg(dropout=0.0)
    torch.manual_seed(3)
    flow = gradient_flow(loss, make_clip())
    for term, row in flow.items():
        for name, gradients in step(loss, make_clip(), terms=[term]).items():
            flat = [grad.flatten() for grad in gradients if grad is not None]
            expected = torch.cat(flat).norm().item() if flat else 0.0
            assert row[name] == pytest.approx(expected, rel=1e-5)


def test_gradient_flow_reports_zeros_for_a_frozen_encoder(make_ficreg, make_clip):
    loss = make_ficreg()
    loss.encoder_params.requires_grad_(False)
    flow = gradient_flow(loss, make_clip())
    assert [flow[term]["encoder"] for term in flow] == [0.0] * 4
    assert flow["loss_pred"]["predictor"] > 0
    assert flow["loss_consistency"]["predictor"] > 0


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("seed", range(4))
def test_the_encoder_learns_exactly_as_under_lewm(make_ficreg, make_lewm, make_clip, seed, precision):
    """Same seed, dropout and BatchNorm in train mode: not one bit of the encoder's gradient differs."""
    clip = make_clip(seed=seed)
    judged = step(make_ficreg(consistency_coeff=10.0, idm_coeff=10.0), clip, seed, precision)
    baseline = step(make_lewm(), clip, seed, precision)
    for ours, theirs in zip(judged["encoder"], baseline["encoder"], strict=True):
        assert ours.equal(theirs)
    assert not all(ours.equal(theirs) for ours, theirs in zip(judged["predictor"], baseline["predictor"]))


def test_it_stays_so_with_dropout_in_the_inverse_model(networks, make_lewm, make_clip):
    from torchrl_ficreg import FICRegLoss, InverseDynamicsModel, SIGReg

    encoder, predictor, _ = networks()
    loss = FICRegLoss(encoder, predictor, InverseDynamicsModel(6, 6, 16, dropout=0.5), sigreg=SIGReg(16))
    judged, baseline = step(loss, make_clip()), step(make_lewm(), make_clip())
    assert all(ours.equal(theirs) for ours, theirs in zip(judged["encoder"], baseline["encoder"], strict=True))


def test_running_statistics_move_once_a_step_and_as_under_lewm(make_ficreg, make_lewm, make_clip):
    judged, baseline = make_ficreg(), make_lewm()
    step(judged, make_clip()), step(baseline, make_clip())
    for name in ("encoder", "predictor"):
        ours, theirs = (dict(getattr(loss, name).named_buffers()) for loss in (judged, baseline))
        assert all(ours[key].equal(theirs[key]) for key in theirs)
        assert [value.item() for key, value in ours.items() if key.endswith("num_batches_tracked")] == [1]


def test_the_consistency_term_leaves_the_judge_as_it_is(make_ficreg, make_clip):
    loss = make_ficreg()
    before = [param.detach().clone() for param in loss.inverse_model.parameters()]
    optimizer = torch.optim.AdamW(loss.parameters(), lr=0.1)
    gradients = step(loss, make_clip(), terms=["loss_consistency"])
    optimizer.step()
    assert all(grad is None for grad in gradients["inverse_model"])
    assert all(param.equal(was) for param, was in zip(loss.inverse_model.parameters(), before, strict=True))
    assert all(param.requires_grad for param in loss.inverse_model.parameters())


def test_the_judge_is_as_good_as_the_inverse_model_is_now(make_ficreg, make_clip):
    """Frozen means without gradient, not out of date: new weights judge at once, however they were put there."""
    loss, clip = make_ficreg().eval(), make_clip()
    start = loss(clip)["loss_consistency"]
    with torch.no_grad():
        loss.inverse_model.module.layers[-1].bias.add_(1.0)
    in_place = loss(clip)["loss_consistency"]
    bias = loss.inverse_model.module.layers[-1].bias
    bias.data = bias.data - 1.0  # as torch.nn.utils.vector_to_parameters does
    assert in_place > start
    torch.testing.assert_close(loss(clip)["loss_consistency"], start)


def test_a_live_context_reaches_the_encoder_as_algorithm_1_does(make_ficreg, make_clip):
    flow = gradient_flow(make_ficreg(context="live"), make_clip())
    assert flow["loss_consistency"]["encoder"] > 0
    assert flow["loss_consistency"]["inverse_model"] == 0.0
    assert flow["loss_idm"]["encoder"] == 0.0


def test_both_contexts_teach_the_predictor_the_same(make_ficreg, make_clip):
    terms = ["loss_consistency"]
    live = step(make_ficreg(0.0, context="live"), make_clip(), terms=terms)["predictor"]
    detached = step(make_ficreg(0.0), make_clip(), terms=terms)["predictor"]
    for ours, theirs in zip(detached, live, strict=True):
        torch.testing.assert_close(ours, theirs)
