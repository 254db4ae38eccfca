"""Claims about the judge: when it pushes, when it holds its tongue, and whether it is worth listening to."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from _loss_test_base import call, total
from loss_collection import BLOCK, COLLECTION, FICREG, LATENT, make_clip, make_loss, make_mask
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import FICRegLoss, gradient_flow, InverseDynamicsModel, make_world_model, ModelConfig, SIGReg
from torchrl_ficreg.objectives import ficreg
from torchrl_ficreg.objectives.inverse_terms import judge_report

NETWORKS = ("encoder", "predictor", "inverse_model")


def gradients(loss, clip, terms=None):
    loss.zero_grad()
    output = call(loss, clip)
    total(output if terms is None else output.select(*terms)).backward()
    return {name: [p.grad for p in getattr(loss, f"{name}_params").parameters()] for name in loss._networks}


def latents(loss, clip):
    """In eval mode: real latents [B, T, D], predictions and the action blocks between them [B, T - 1, ...]."""
    real = loss.encoder.module(clip["pixels"]).detach()
    action = clip["action"][:, :-1]
    return real, loss.predictor.module(real[:, :-1], action), action


# Who receives gradient


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("name", COLLECTION)
def test_gradient_flow_is_the_table_of_the_loss(name, precision):
    """Exact zeros, of every loss in the collection."""
    loss, table = make_loss(name), COLLECTION[name][3]
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
        flow = gradient_flow(loss, make_clip())
    assert {term: {network: norm != 0.0 for network, norm in row.items()} for term, row in flow.items()} == table


@pytest.mark.parametrize("name", [name for name in FICREG if "live" not in name])
def test_the_encoder_learns_exactly_as_under_lewm(name):
    """Whatever the judge: not one bit of the encoder's gradient differs, with dropout and BatchNorm in train mode."""
    judged = gradients(make_loss(name, consistency_coeff=10.0, idm_coeff=10.0), make_clip())
    baseline = gradients(make_loss("lewm"), make_clip())
    assert all(ours.equal(theirs) for ours, theirs in zip(judged["encoder"], baseline["encoder"], strict=True))
    assert not all(ours.equal(theirs) for ours, theirs in zip(judged["predictor"], baseline["predictor"]))


@pytest.mark.parametrize("name", FICREG)
def test_without_mu_and_gamma_it_is_lewm_to_the_last_bit(name):
    judged, baseline = make_loss(name, consistency_coeff=0.0, idm_coeff=0.0), make_loss("lewm")
    ours, theirs = call(judged, make_clip()), call(baseline, make_clip())
    assert all(ours[term].equal(theirs[term]) for term in theirs.keys())
    assert total(ours).equal(total(theirs))


@pytest.mark.parametrize("name", FICREG)
def test_the_consistency_term_leaves_the_judge_as_it_is(name):
    """Bit for bit, parameters and buffers, after a step of an optimiser with weight decay."""
    loss = make_loss(name)
    before = {key: value.clone() for key, value in loss.inverse_model_params.flatten_keys().items()}
    optimizer = torch.optim.AdamW(loss.parameters(), lr=0.1)
    found = gradients(loss, make_clip(), ["loss_consistency"])["inverse_model"]
    optimizer.step()
    assert all(grad is None for grad in found)
    assert all(value.equal(before[key]) for key, value in loss.inverse_model_params.flatten_keys().items())


@pytest.mark.parametrize("name", ["joint", "joint_bare", "pldm"])
def test_a_joint_inverse_model_shapes_the_encoder(name):
    found = gradients(make_loss(name), make_clip(), ["loss_idm"])
    assert sum(grad.norm() for grad in found["encoder"]) > 0
    assert all(grad is None for grad in found["predictor"])


# The terms are their formulas


def test_a_gaussian_judge_is_trained_and_judges_by_likelihood():
    loss, clip = make_loss("nll", idm_coeff=1.0, consistency_coeff=1.0).eval(), make_clip()
    real, predicted, action = latents(loss, clip)
    output = call(loss, clip)
    for term, after in (("loss_idm", real[:, 1:]), ("loss_consistency", predicted)):
        mean, log_var = loss.inverse_model.module(real[:, :-1], after)
        torch.testing.assert_close(output[term], F.gaussian_nll_loss(mean, action, log_var.exp()))


def test_an_ensemble_is_trained_by_the_mean_of_its_members_errors():
    """And not by the error of their mean, which would let them differ for nothing; judged is by their mean."""
    loss, clip = make_loss("ensemble", idm_coeff=1.0, consistency_coeff=1.0).eval(), make_clip()
    real, predicted, action = latents(loss, clip)
    output, members = call(loss, clip), loss.inverse_model.module.members
    errors = [F.mse_loss(member(real[:, :-1], real[:, 1:]), action) for member in members]
    torch.testing.assert_close(output["loss_idm"], torch.stack(errors).mean())
    mean = torch.stack([member(real[:, :-1], predicted) for member in members]).mean(0)
    torch.testing.assert_close(output["loss_consistency"], F.mse_loss(mean, action))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("context", ["detached", "live"])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_deep_judgements_are_those_of_a_loop_by_hand(steps, context, masked):
    """Each transition's error is the mean over the depths at which it is reached by unmasked steps."""
    networks = ConvTriple()
    loss = FICRegLoss(*networks, sigreg=SIGReg(4), consistency_steps=steps, consistency_coeff=1.0, context=context)
    clip = make_clip(frames=5)
    mask = make_mask(frames=5) if masked else torch.ones(8, 5, dtype=torch.bool)
    mask[0, :4] = True
    clip["mask"] = mask
    output = call(loss.eval(), clip)
    real, action, inverse = networks[0].module(clip["pixels"]), clip["action"], networks[2].module
    errors = {}  # (clip, transition): errors at all depths
    for start in range(4):
        latent = real[:, start]
        for depth in range(min(steps, 4 - start)):
            at = start + depth
            imagined = networks[1].module(latent, action[:, at])
            error = (inverse(latent, imagined) - action[:, at]).square().mean(-1)
            for row in range(8):
                if mask[row, start : at + 1].all():
                    errors.setdefault((row, at), []).append(error[row])
            latent = imagined
    expected = torch.stack([torch.stack(each).mean() for each in errors.values()]).mean()
    assert len(errors) == mask[:, :4].sum()
    torch.testing.assert_close(output["loss_consistency"], expected)


def test_deep_judgements_need_long_clips():
    with pytest.raises(ValueError, match="consistency_steps=2 needs clips of 3 frames, got 2: sample longer clips"):
        make_loss("two_steps")(make_clip(frames=2))


# A judge that knows when it does not know


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_a_trust_of_1_is_mse_to_the_last_bit(monkeypatch, reduction):
    monkeypatch.setattr(ficreg, "trust", torch.ones_like)
    clip = make_clip().set("mask", make_mask())
    losses = make_loss("trusted", reduction=reduction), make_loss("paper", reduction=reduction)
    ours, theirs = (gradients(loss, clip)["predictor"] for loss in losses)
    assert all(one.equal(other) for one, other in zip(ours, theirs, strict=True))
    outputs = [call(loss, clip)["loss_consistency"] for loss in losses]
    assert outputs[0].equal(outputs[1])


class _Says(nn.Module):
    """Recovers what it was told the real action is, plus an error, plus a little of the transition."""

    def __init__(self, said: torch.Tensor) -> None:
        super().__init__()
        self.said, self.weight = said, nn.Parameter(torch.ones(()))

    def forward(self, latent, next_latent):
        return self.said + 0 * self.weight * latent.sum() + self.weight * (next_latent - next_latent.detach())


def _judged_by(error: torch.Tensor, clip, **arguments):
    encoder, predictor, _ = (getattr(make_loss("paper", 0.0), name) for name in NETWORKS)
    judge = TensorDictModule(_Says(clip["action"][:, :-1] + error), ["latent", "next"], ["recovered_action"])
    return FICRegLoss(encoder, predictor, judge, sigreg=SIGReg(4), consistency_coeff=1.0, **arguments)


@pytest.mark.parametrize("error", [1.001, -1.5, 100.0])
def test_a_useless_judge_does_not_push(error):
    clip = make_clip()
    trusted = gradients(_judged_by(torch.tensor(error), clip, consistency="trusted"), clip, ["loss_consistency"])
    plain = gradients(_judged_by(torch.tensor(error), clip), clip, ["loss_consistency"])
    assert all((grad == 0).all() for grad in trusted["predictor"])
    assert sum(grad.norm() for grad in plain["predictor"]) > 0


def test_trust_is_given_dimension_by_dimension():
    clip, error = make_clip(), torch.tensor([0.0, 0.5, 0.9, 1.0, 2.0, -0.5])
    output = _judged_by(error, clip, consistency="trusted", diagnostics=True)(clip)
    torch.testing.assert_close(output["judge_trust"], (1 - error.square()).clamp_min(0))
    expected = ((1 - error.square()).clamp_min(0) * error.square()).mean()
    torch.testing.assert_close(output["loss_consistency"], expected)


def test_reality_itself_is_a_perfect_prediction_for_a_judge_as_target():
    """Zero loss and gradient where prediction equals reality, however wrong the judge; the plain target pushes on."""

    class _Reality(nn.Linear):  # all frames are the same, so staying where one is is a perfect prediction
        def forward(self, latent, action):
            return latent + (super().forward(action) - super().forward(action).detach())

    clip = make_clip()
    clip["pixels"] = clip["pixels"][:, :1].expand(8, 3, 3, 16, 16).clone()
    for target, moves in (("judge", False), ("action", True)):
        encoder, _, inverse_model = (getattr(make_loss("paper", 0.0), name) for name in NETWORKS)
        predictor = TensorDictModule(_Reality(BLOCK, LATENT), ["latent", "action"], ["predicted_latent"])
        loss = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(4), consistency_target=target)
        norm = sum(grad.norm() for grad in gradients(loss.eval(), clip, ["loss_consistency"])["predictor"])
        value = call(loss, clip)["loss_consistency"]
        assert (value > 1e-9) == moves
        assert (norm > 1e-5) == moves


def test_a_transformer_judge_is_causal_and_sees_history():
    torch.manual_seed(0)
    judge = InverseDynamicsModel(4, 3, 16, kind="transformer", history=5).eval().module
    latent, after = torch.randn(2, 5, 4).requires_grad_(), torch.randn(2, 5, 4).requires_grad_()
    reached = []
    for step in range(5):
        grads = torch.autograd.grad(judge(latent, after)[:, step].sum(), (latent, after))
        reached.append([[bool(row.any()) for row in grad.transpose(0, 1)] for grad in grads])
    for step, (history, imagined) in enumerate(reached):
        assert history == [at <= step for at in range(5)]
        assert imagined == [at == step for at in range(5)]
    with pytest.raises(ValueError, match="sees 1 to 5 latents, got 6: .* history=6"):
        judge(torch.zeros(2, 6, 4), torch.zeros(2, 6, 4))


@pytest.mark.parametrize("kind", ["mlp", "gaussian", "ensemble"])
def test_other_judges_look_at_one_transition_only(kind):
    judge = InverseDynamicsModel(4, 3, 16, kind=kind)
    latent, after = torch.randn(2, 5, 4), torch.randn(2, 5, 4)
    whole = judge.module(latent, after)
    single = judge.module(latent[:, 2], after[:, 2])
    for one, other in zip((whole, single) if kind == "mlp" else whole, (single,) if kind == "mlp" else single):
        torch.testing.assert_close(*((whole[:, 2], single) if kind == "mlp" else (one[:, 2], other)))


def test_wrong_inverse_models_are_refused():
    with pytest.raises(ValueError, match="unknown kind of inverse model 'linear': choose one of"):
        InverseDynamicsModel(4, 3, kind="linear")
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        InverseDynamicsModel(4, 3, kind="ensemble", members=1)


# The report


def test_a_good_judge_likes_right_actions_and_no_others():
    """Its R² is that of its error; on the actions of other clips it is clearly worse than on the true ones."""
    generator = torch.Generator().manual_seed(0)
    action, error = (torch.randn(256, 3, 4, generator=generator) for _ in range(2))
    report = judge_report(action + 0.3 * error, action + 0.6 * error, action, None)
    for name, expected in (("real", 1 - 0.09), ("imagined", 1 - 0.36), ("shuffled", -1 - 0.36)):
        torch.testing.assert_close(report[f"judge_r2_{name}"], torch.full((4,), expected), rtol=0, atol=0.2)
    assert (report["judge_r2_shuffled"] < report["judge_r2_imagined"] - 0.5).all()


def test_a_judge_that_always_says_the_same_is_found_out():
    action = torch.randn(256, 3, 4, generator=torch.Generator().manual_seed(0))
    report = judge_report(torch.zeros_like(action), torch.zeros_like(action), action, None)
    assert all((value < 0.01).all() for value in report.values())
    torch.testing.assert_close(report["judge_r2_shuffled"], report["judge_r2_imagined"])


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-4])
def test_an_action_that_hardly_varies_leaves_nothing_to_explain(scale):
    """Its R² is 0 whatever the judge says, and so is that of a batch whose mask leaves nothing."""
    action, guess = (torch.randn(64, 3, 4, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))
    action[..., 1] = 0.3 + scale * action[..., 1]
    for name, value in judge_report(guess, action, action, None).items():
        assert value[1] == 0
        assert (value[[0, 2, 3]] != 0).all(), name
    nothing = judge_report(guess, guess, action, torch.zeros(64, 3, dtype=torch.bool))
    assert all((value == 0).all() for value in nothing.values())


def test_masked_transitions_are_not_in_the_report():
    """Neither as the transition judged, nor as another clip's action."""
    generator = torch.Generator().manual_seed(0)
    action, real, imagined = (torch.randn(32, 3, 4, generator=generator) for _ in range(3))
    mask = torch.arange(32)[:, None].expand(32, 3) < 20
    report = judge_report(*(torch.where(mask[..., None], value, 1e6) for value in (real, imagined, action)), mask)
    expected = judge_report(real[:20], imagined[:20], action[:20], None)
    for name in ("judge_r2_real", "judge_r2_imagined"):
        torch.testing.assert_close(report[name], expected[name])
    # clip 0 has clip 31 before it, which is masked: 19 pairs are left
    pairs = judge_report(imagined[1:20], imagined[1:20], action[:19], None)["judge_r2_imagined"]
    torch.testing.assert_close(report["judge_r2_shuffled"], pairs)


def test_diagnostics_are_detached_numbers_per_action_dimension_and_follow_the_mask():
    clip, loss = make_clip(), make_loss("diagnostics", consistency="trusted").eval()
    clip["mask"] = torch.arange(8)[:, None].expand(8, 3) < 5
    output, expected = call(loss, clip), call(loss, clip[:5].exclude("mask"))
    for name in ("judge_r2_real", "judge_r2_imagined", "judge_trust"):
        assert output[name].shape == (BLOCK,)
        assert not output[name].requires_grad
        torch.testing.assert_close(output[name], expected[name])
    assert (output["judge_r2_imagined"] <= 1).all()


def ConvTriple():
    """Encoder, a predictor of one step, and an inverse model, without memory of earlier steps."""

    class _Step(nn.Linear):
        def forward(self, latent, action):
            return torch.tanh(super().forward(torch.cat([latent, action], -1)))

    encoder, _, inverse_model = (getattr(make_loss("paper", 0.0), name) for name in NETWORKS)
    predictor = TensorDictModule(_Step(LATENT + BLOCK, LATENT), ["latent", "action"], ["predicted_latent"])
    return encoder.eval(), predictor, inverse_model


@pytest.mark.parametrize("context", ["detached", "live"])
def test_the_frozen_judge_moves_no_buffer(context):
    """BatchNorm statistics of an inverse model are those of real transitions: they move once a step."""

    class Inverse(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.norm, self.out = torch.nn.BatchNorm1d(32), torch.nn.Linear(32, 10)

        def forward(self, before, after):
            pairs = torch.cat([before, after], -1)
            return self.out(self.norm(pairs.flatten(0, -2))).unflatten(0, pairs.shape[:-1])

    model, _ = make_world_model(ModelConfig.preset("cpu"), 2)
    inverse = TensorDictModule(Inverse(), ["before", "after"], ["recovered_action"])
    loss = FICRegLoss(model.encoder, model.predictor, inverse, context=context)
    pixels = torch.randint(0, 256, (8, 2, 3, 64, 64), dtype=torch.uint8)
    loss(TensorDict({"pixels": pixels, "action": torch.randn(8, 2, 10)}, [8, 2]))
    assert inverse.module.norm.num_batches_tracked == 1
    assert model.predictor.module.projector.norm.num_batches_tracked == 1
