"""Claims about the variants of FICReg: likelihood, ensemble, deep rollouts, reliability weights, target, diagnostics."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from _losses import all_equal, BLOCK, call, gradients, LATENT, make_clip, make_loss, make_mask, make_networks
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import FICRegLoss, SIGReg
from torchrl_ficreg.objectives import ficreg


def latents(loss, clip):
    """In eval mode: real latents [B, T, D], predictions and the action blocks between them [B, T - 1, ...]."""
    real = loss.encoder.module(clip["pixels"]).detach()
    action = clip["action"][:, :-1]
    return real, loss.predictor.module(real[:, :-1], action), action


def test_a_gaussian_inverse_model_is_trained_and_evaluated_by_likelihood():
    loss, clip = make_loss("nll", idm_coeff=1.0, consistency_coeff=1.0).eval(), make_clip()
    real, predicted, action = latents(loss, clip)
    output = call(loss, clip)
    for term, after in (("loss_idm", real[:, 1:]), ("loss_consistency", predicted)):
        mean, log_var = loss.inverse_model.module(real[:, :-1], after)
        torch.testing.assert_close(output[term], F.gaussian_nll_loss(mean, action, log_var.exp()))


def test_an_ensemble_is_trained_by_the_mean_of_its_members_errors():
    """The error of their mean would not bound their variance; consistency is that of their mean."""
    loss, clip = make_loss("ensemble", idm_coeff=1.0, consistency_coeff=1.0).eval(), make_clip()
    real, predicted, action = latents(loss, clip)
    output, members = call(loss, clip), loss.inverse_model.module.members
    errors = [F.mse_loss(member(real[:, :-1], real[:, 1:]), action) for member in members]
    torch.testing.assert_close(output["loss_idm"], torch.stack(errors).mean())
    mean = torch.stack([member(real[:, :-1], predicted) for member in members]).mean(0)
    torch.testing.assert_close(output["loss_consistency"], F.mse_loss(mean, action))


class _OneStep(nn.Linear):
    """A predictor without memory of earlier steps."""

    def forward(self, latent, action):
        return torch.tanh(super().forward(torch.cat([latent, action], -1)))


@pytest.mark.parametrize(
    ("steps", "context", "masked"),
    [(1, "detached", True), (2, "detached", False), (2, "live", True), (3, "detached", True), (3, "live", False)],
)
def test_consistency_of_deep_rollouts_is_that_of_a_loop(steps, context, masked):
    """The error of a transition is the mean over the depths at which unmasked steps reach it."""
    encoder, _, inverse_model = make_networks(0.0)
    predictor = TensorDictModule(_OneStep(LATENT + BLOCK, LATENT), ["latent", "action"], ["predicted_latent"])
    loss = FICRegLoss(
        encoder, predictor, inverse_model, sigreg=SIGReg(4), consistency_steps=steps, consistency_coeff=1.0, context=context
    ).eval()
    clip = make_clip(frames=5)
    mask = make_mask(frames=5) if masked else torch.ones(8, 5, dtype=torch.bool)
    mask[0, :4] = True
    clip["mask"] = mask
    output = call(loss, clip)
    real, action, inverse = encoder.module(clip["pixels"]), clip["action"], inverse_model.module
    errors = {}  # (clip, transition): errors at all depths
    for start in range(4):
        latent = real[:, start]
        for depth in range(min(steps, 4 - start)):
            at = start + depth
            imagined = predictor.module(latent, action[:, at])
            error = (inverse(latent, imagined) - action[:, at]).square().mean(-1)
            for row in range(8):
                if mask[row, start : at + 1].all():
                    errors.setdefault((row, at), []).append(error[row])
            latent = imagined
    expected = torch.stack([torch.stack(each).mean() for each in errors.values()]).mean()
    assert len(errors) == mask[:, :4].sum()
    torch.testing.assert_close(output["loss_consistency"], expected)


def test_deep_rollouts_need_long_clips():
    with pytest.raises(ValueError, match="consistency_steps=2 needs clips of 3 frames, got 2: sample longer clips"):
        make_loss("two_steps")(make_clip(frames=2))


# Weighted by reliability


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_weights_of_1_are_mse_to_the_last_bit(monkeypatch, reduction):
    monkeypatch.setattr(ficreg, "reliability_weight", torch.ones_like)
    clip = make_clip().set("mask", make_mask())
    losses = make_loss("trusted", reduction=reduction), make_loss("paper", reduction=reduction)
    assert all_equal(*(gradients(loss, clip)["predictor"] for loss in losses))
    assert all_equal(*([call(loss, clip)["loss_consistency"]] for loss in losses))


class _Recovers(nn.Module):
    """Recovers given actions, with a gradient of one by the next latent."""

    def __init__(self, action: torch.Tensor) -> None:
        super().__init__()
        self.action, self.weight = action, nn.Parameter(torch.ones(()))

    def forward(self, latent, next_latent):
        return self.action + 0 * self.weight * latent.sum() + self.weight * (next_latent - next_latent.detach())


def with_error(error: torch.Tensor, clip, **arguments) -> FICRegLoss:
    """A loss whose inverse model has this error on every transition."""
    encoder, predictor, _ = make_networks(0.0)
    inverse_model = TensorDictModule(_Recovers(clip["action"][:, :-1] + error), ["latent", "next"], ["recovered_action"])
    return FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(4), consistency_coeff=1.0, **arguments)


@pytest.mark.parametrize(
    ("error", "consistency", "moves"), [(1.001, "trusted", False), (-1.5, "trusted", False), (1.5, "mse", True)]
)
def test_an_uninformative_inverse_model_gives_no_gradient(error, consistency, moves):
    clip = make_clip()
    found = gradients(with_error(torch.tensor(error), clip, consistency=consistency), clip, "loss_consistency")
    assert any((grad != 0).any() for grad in found["predictor"]) == moves


def test_weights_are_those_of_each_dimension():
    clip, error = make_clip(), torch.tensor([0.0, 0.5, 0.9, 1.0, 2.0, -0.5])
    output = with_error(error, clip, consistency="trusted", diagnostics=True)(clip)
    torch.testing.assert_close(output["judge_trust"], (1 - error.square()).clamp_min(0))
    expected = ((1 - error.square()).clamp_min(0) * error.square()).mean()
    torch.testing.assert_close(output["loss_consistency"], expected)


# Target and diagnostics


def test_with_the_recovered_action_as_target_real_latents_are_a_perfect_prediction():
    """Zero loss and gradient where prediction equals reality, whatever the inverse model; not so for the action."""

    class _Reality(nn.Linear):  # all frames are the same, so the same latent is a perfect prediction
        def forward(self, latent, action):
            return latent + (super().forward(action) - super().forward(action).detach())

    clip = make_clip()
    clip["pixels"] = clip["pixels"][:, :1].expand(8, 3, 3, 16, 16).clone()
    for target, moves in (("judge", False), ("action", True)):
        encoder, _, inverse_model = make_networks(0.0)
        predictor = TensorDictModule(_Reality(BLOCK, LATENT), ["latent", "action"], ["predicted_latent"])
        loss = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(4), consistency_target=target).eval()
        norm = sum(grad.norm() for grad in gradients(loss, clip, "loss_consistency")["predictor"])
        assert (call(loss, clip)["loss_consistency"] > 1e-9) == moves
        assert (norm > 1e-5) == moves


def test_diagnostics_are_numbers_per_action_dimension_follow_the_mask_and_change_no_term():
    clip, loss = make_clip(), make_loss("diagnostics", consistency="trusted").eval()
    clip["mask"] = torch.arange(8)[:, None].expand(8, 3) < 5
    output, expected = call(loss, clip), call(loss, clip[:5].exclude("mask"))
    for name in ("judge_r2_real", "judge_r2_imagined", "judge_trust"):
        assert output[name].shape == (BLOCK,)
        torch.testing.assert_close(output[name], expected[name])
    assert (output["judge_r2_imagined"] <= 1).all()
    assert all(output[key].equal(value) for key, value in call(make_loss("trusted").eval(), clip).items())
