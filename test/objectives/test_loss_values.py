"""Claims about the numbers of the losses: the formulas, the reductions, the mask, the coefficients."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

TERMS = ("loss_pred", "loss_idm", "loss_consistency")


def values(loss, clip, seed=0):
    torch.manual_seed(seed)
    loss.sigreg.generator_state[1] = 0
    return loss(clip)


def test_the_terms_are_the_formulas_of_the_paper(make_ficreg, make_clip):
    loss, clip = make_ficreg(sigreg_coeff=0.5, idm_coeff=0.25, consistency_coeff=4.0).eval(), make_clip()
    latent = loss.encoder.module(clip["pixels"])
    predicted = loss.predictor.module(latent[:, :-1], clip["action"][:, :-1])
    inverse, action = loss.inverse_model.module, clip["action"][:, :-1]
    torch.manual_seed(0)
    expected = {
        "loss_pred": F.mse_loss(predicted, latent[:, 1:]),
        "loss_sigreg": 0.5 * loss.sigreg(latent.transpose(0, 1)),
        "loss_idm": 0.25 * F.mse_loss(inverse(latent[:, :-1], latent[:, 1:]), action),
        "loss_consistency": 4.0 * F.mse_loss(inverse(latent[:, :-1], predicted), action),
    }
    output = values(loss, clip)
    assert set(output.keys()) == set(expected)
    assert output.batch_size == torch.Size([])
    for term, value in expected.items():
        torch.testing.assert_close(output[term], value)


def test_without_mu_and_gamma_it_is_lewm_to_the_last_bit(make_ficreg, make_lewm, make_clip):
    judged, baseline = make_ficreg(idm_coeff=0.0, consistency_coeff=0.0), make_lewm()
    ours, theirs = values(judged, make_clip()), values(baseline, make_clip())
    assert ours["loss_idm"] == ours["loss_consistency"] == 0
    assert all(ours[term].equal(theirs[term]) for term in theirs.keys())
    sum(ours.values()).backward()
    sum(theirs.values()).backward()
    for name in ("encoder", "predictor"):
        for one, other in zip(getattr(judged, name).parameters(), getattr(baseline, name).parameters(), strict=True):
            assert one.grad.equal(other.grad)


@pytest.mark.parametrize("context", ["detached", "live"])
def test_both_contexts_have_the_same_values_without_dropout(make_ficreg, make_clip, context):
    expected = values(make_ficreg(0.0), make_clip())
    output = values(make_ficreg(0.0, context=context), make_clip())
    torch.testing.assert_close(output, expected)


def test_leading_dimensions_are_one_batch(make_ficreg, make_clip):
    """A clip [2, 4, T] is the clip [8, T]: values, gradients, and the shape of unreduced terms."""
    flat, clip = make_clip(8), make_clip(2, 4)
    assert clip["pixels"].flatten(0, 1).equal(flat["pixels"])
    losses = make_ficreg(), make_ficreg()
    outputs = [values(loss, given) for loss, given in zip(losses, (flat, clip))]
    torch.testing.assert_close(outputs[1], outputs[0])
    for output in outputs:
        sum(output.values()).backward()
    for ours, theirs in zip(losses[1].parameters(), losses[0].parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad)
    unreduced = values(make_ficreg(reduction="none"), clip)
    assert [unreduced[term].shape for term in TERMS] == [torch.Size([2, 4, 2])] * 3


@pytest.mark.parametrize("masked", [False, True])
def test_mean_and_sum_are_those_of_the_unreduced_terms(make_ficreg, make_clip, masked):
    clip = make_clip()
    kept = torch.ones(8, 3, dtype=torch.bool)
    if masked:
        kept = torch.rand(8, 3, generator=torch.Generator().manual_seed(0)) > 0.4
        clip["mask"] = kept
    none, mean, total = (values(make_ficreg(reduction=how), clip) for how in ("none", "mean", "sum"))
    for term in TERMS:
        assert none[term].shape == (8, 2)
        assert (none[term][~kept[:, :-1]] == 0).all()
        torch.testing.assert_close(mean[term], none[term][kept[:, :-1]].mean())
        torch.testing.assert_close(total[term], none[term].sum())
    assert none["loss_sigreg"].equal(mean["loss_sigreg"])
    assert none["loss_sigreg"].equal(total["loss_sigreg"])


@pytest.mark.parametrize("context", ["detached", "live"])
@pytest.mark.parametrize("poison", [torch.nan, torch.inf, 1e30])
def test_masked_transitions_contribute_nothing_whatever_their_action(make_ficreg, make_clip, context, poison):
    """The last block of half the clips is masked: the terms are those of the blocks that are left."""
    clip, mask = make_clip(), torch.ones(8, 3, dtype=torch.bool)
    mask[4:, 1] = False
    expected = values(make_ficreg(reduction="none", context=context).eval(), clip)
    clip["mask"] = mask
    clip["action"][4:, 1] = poison
    clip["action"][:, 2] = poison  # leads out of the clip: never read, masked or not
    loss = make_ficreg(context=context).eval()
    output = values(loss, clip)
    for term in TERMS:
        torch.testing.assert_close(output[term], expected[term][mask[:, :-1]].mean())
    sum(output.values()).backward()
    assert all(param.grad.isfinite().all() for param in loss.parameters())


def test_a_wholly_masked_clip_adds_nothing_to_a_batch(make_ficreg, make_clip):
    clip, loss = make_clip(), make_ficreg(reduction="sum").eval()
    clip["mask"] = torch.arange(8)[:, None].expand(8, 3) < 6
    output, expected = values(loss, clip), values(loss, clip[:6])
    for term in TERMS:
        torch.testing.assert_close(output[term], expected[term])
    sum(output.values()).backward()
    assert all(param.grad.isfinite().all() for param in loss.parameters())


def test_a_mask_of_ones_changes_nothing(make_ficreg, make_clip):
    clip = make_clip()
    expected = values(make_ficreg(), clip)
    clip["mask"] = torch.ones(8, 3, dtype=torch.bool)
    torch.testing.assert_close(values(make_ficreg(), clip), expected)


def test_coefficients_scale_their_term_can_be_assigned_and_are_saved(make_ficreg, make_clip):
    loss, clip = make_ficreg().eval(), make_clip()
    before = values(loss, clip)
    for coeff, term in (
        ("sigreg_coeff", "loss_sigreg"),
        ("idm_coeff", "loss_idm"),
        ("consistency_coeff", "loss_consistency"),
    ):
        buffer = getattr(loss, coeff)
        setattr(loss, coeff, 3 * buffer.item())
        assert getattr(loss, coeff) is buffer  # in place: a compiled loss follows
        torch.testing.assert_close(values(loss, clip)[term], 3 * before[term])
        torch.testing.assert_close(loss.state_dict()[coeff], buffer)


def test_terms_are_float32_inside_autocast(make_ficreg, make_clip):
    with torch.autocast("cpu", torch.bfloat16):
        output = values(make_ficreg(), make_clip())
    assert {value.dtype for value in output.values()} == {torch.float32}
    full = values(make_ficreg(), make_clip())
    torch.testing.assert_close(output, full, rtol=0.1, atol=0.02)
