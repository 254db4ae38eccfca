"""Claims about prediction_steps: rollouts are those of a planner, each depth teaches the networks of the table, masks count.

With z_t the latent of frame t and p_{s, d} the prediction d steps after frame s, made from the last H of z_0 .. z_s,
p_{s, 1} .. p_{s, d - 1}, the error of the transition to frame t is the mean over d = 1 .. min(k, t) of |p_{t - d, d} - z_t|^2.
"""

from __future__ import annotations

import pytest
import torch
from _losses import BLOCK, call, COLLECTION, gradients, LATENT, make_clip, make_loss, make_mask, make_networks, total
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import gradient_flow, LatentWorldModel, LeWMLoss, SIGReg
from torchrl_ficreg.objectives.base import with_own_buffers

CLASSES = ("lewm", "paper", "live", "joint", "pldm")
each_class = pytest.mark.parametrize("name", CLASSES)


def errors_by_hand(loss, latent, action, steps, mask=None):
    """Errors of every (clip, transition) at the depths at which unmasked steps reach it, by LatentWorldModel.rollout."""
    world = LatentWorldModel(loss.encoder, loss.predictor, frame_skip=1, latent_dim=LATENT, action_dim=BLOCK, history=2)
    transitions, errors = latent.shape[1] - 1, {}
    for start in range(transitions):
        depth = min(steps, transitions - start)
        predicted = world.rollout(latent[:, : start + 1], action[:, : start + depth])  # [B, depth, D]
        for ahead in range(depth):
            at = start + ahead
            error = (predicted[:, ahead] - latent[:, at + 1]).square().mean(-1)
            for row in range(len(latent)):
                if mask is None or mask[row, start : at + 1].all():
                    errors.setdefault((row, at), []).append(error[row])
    return errors


@each_class
@pytest.mark.parametrize(
    ("steps", "frames", "masked"), [(1, 3, False), (1, 6, True), (2, 3, False), (2, 6, True), (4, 6, False), (4, 5, True)]
)
def test_the_loss_is_that_of_planned_rollouts(name, steps, frames, masked):
    """With clips of any length, whatever the history of the predictor; unreduced errors are those of each transition."""
    loss, clip = make_loss(name, prediction_steps=steps, reduction="none").eval(), make_clip(frames=frames)
    mask = make_mask(frames=frames)[:, :-1] if masked else None
    if masked:
        mask[0] = True
        clip["mask"] = torch.cat([mask, mask[:, :1]], 1)
        clip["action"] = torch.where(clip["mask"].unsqueeze(-1), clip["action"], torch.nan)  # nothing of it may be read
    latent, action = loss.encoder.module(clip["pixels"]), clip["action"].nan_to_num()
    errors = errors_by_hand(loss, latent, action, steps, mask)
    expected = torch.zeros(8, frames - 1)
    for (row, at), each in errors.items():
        expected[row, at] = torch.stack(each).mean()
    torch.testing.assert_close(call(loss, clip)["loss_pred"], expected)
    for reduction, kept in (("mean", expected.sum() / len(errors)), ("sum", expected.sum())):
        other = make_loss(name, prediction_steps=steps, reduction=reduction).eval()
        torch.testing.assert_close(call(other, clip)["loss_pred"], kept)


def test_gradients_are_those_of_planned_rollouts():
    """In float64, for encoder and predictor: through the fed predictions, through real contexts and through targets."""
    encoder, predictor = (network.double().eval() for network in make_networks()[:2])
    loss, clip = LeWMLoss(encoder, predictor, sigreg=SIGReg(4), prediction_steps=4).eval().double(), make_clip(frames=6)
    clip["action"] = clip["action"].double()
    output = call(loss, clip)["loss_pred"]
    ours = torch.autograd.grad(output, list(loss.parameters()))
    params = [*encoder.parameters(), *predictor.parameters()]
    errors = errors_by_hand(loss, encoder.module(clip["pixels"]), clip["action"], 4)
    expected = torch.stack([torch.stack(each).mean() for each in errors.values()]).mean()
    torch.testing.assert_close(output, expected, rtol=1e-10, atol=0)
    theirs = dict(zip(params, torch.autograd.grad(expected, params), strict=True))
    for param, gradient in zip(loss.parameters(), ours, strict=True):
        torch.testing.assert_close(gradient, theirs[param], rtol=1e-8, atol=1e-12)


# Gradients


@each_class
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_table_holds_at_every_depth(name, steps):
    flow = gradient_flow(make_loss(name, prediction_steps=steps), make_clip(frames=5))
    assert {term: {network: norm != 0.0 for network, norm in row.items()} for term, row in flow.items()} == COLLECTION[name][3]


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_a_prediction_of_each_depth_alone_teaches_encoder_and_predictor(depth):
    """Through its target and its context."""
    loss, clip = make_loss("lewm", prediction_steps=3), make_clip(frames=4)
    latent = loss._encode(loss._read(clip))
    predicted = loss._rollout(loss._read(clip), latent, 3)[depth - 1]
    assert predicted.shape == (8, 4 - depth, LATENT)
    for output, encoder, predictor in ((predicted, True, True), (latent[:, depth:], True, False)):
        reached = torch.autograd.grad(output.square().sum(), list(loss.parameters()), retain_graph=True, allow_unused=True)
        norms = {name: sum(0 if g is None else g.norm() for g in reached[part]) for name, part in _parts(loss)}
        assert {name: bool(norm > 0) for name, norm in norms.items()} == {"encoder": encoder, "predictor": predictor}


def _parts(loss):
    ours = {id(param) for param in loss.encoder_params.parameters()}
    places = [id(param) in ours for param in loss.parameters()]
    count = sum(places)
    assert places == sorted(places, reverse=True)  # the encoder's come first
    return ("encoder", slice(count)), ("predictor", slice(count, None))


def test_the_encoder_of_ficreg_learns_as_under_lewm():
    """Bit for bit, with dropout, when both look several steps ahead."""
    clip = make_clip(frames=5)
    ours = gradients(make_loss("paper", prediction_steps=3, consistency_steps=2, consistency_coeff=10.0), clip)
    theirs = gradients(make_loss("lewm", prediction_steps=3), clip)
    assert all(one.equal(other) for one, other in zip(ours["encoder"], theirs["encoder"], strict=True))


@pytest.mark.parametrize(("name", "prediction_steps"), [("paper", 1), ("paper", 3), ("live", 1), ("live", 4)])
def test_the_consistency_term_is_that_of_planned_rollouts(name, prediction_steps):
    """The inverse model reads the last transition of each, whatever the depth of the other term."""
    arguments = {"prediction_steps": prediction_steps, "consistency_steps": 3, "consistency_coeff": 1.0}
    loss, clip = make_loss(name, **arguments).eval(), make_clip(frames=6)
    real, action = loss.encoder.module(clip["pixels"]), clip["action"]
    world = LatentWorldModel(loss.encoder, loss.predictor, frame_skip=1, latent_dim=LATENT, action_dim=BLOCK, history=2)
    errors = [[] for _ in range(5)]
    for start in range(5):
        predicted = world.rollout(real[:, : start + 1], action[:, : min(start + 3, 5)])
        path = torch.cat([real[:, start : start + 1], predicted], 1)
        for at in range(start, min(start + 3, 5)):
            recovered = loss.inverse_model.module(path[:, at - start], path[:, at - start + 1])
            errors[at].append((recovered - action[:, at]).square().mean())
    expected = torch.stack([torch.stack(each).mean() for each in errors]).mean()
    torch.testing.assert_close(call(loss, clip)["loss_consistency"], expected)


def test_both_terms_share_one_rollout_in_a_live_context_and_on_given_latents(monkeypatch):
    calls, run, clip = [], LeWMLoss._run, make_clip(frames=5)
    latents = clip.exclude("pixels").set("latent", torch.randn(8, 5, LATENT))
    monkeypatch.setattr(LeWMLoss, "_run", lambda self, name, *args: calls.append(name) or run(self, name, *args))
    for name, given, passes in (("live", clip, 3), ("paper", clip, 5), ("paper", latents, 3)):
        calls.clear()
        make_loss(name, prediction_steps=3, consistency_steps=2)(given)
        assert calls.count("predictor") == passes


# Statistics, latents, networks of one's own


@each_class
def test_running_statistics_are_those_of_one_step_ahead(name):
    losses = [make_loss(name, prediction_steps=steps) for steps in (1, 3)]
    for loss in losses:
        total(call(loss, make_clip(frames=5))).backward()
    for network in ("encoder", "predictor"):
        one, several = (dict(getattr(loss, network).named_buffers()) for loss in losses)
        assert all(one[key].equal(several[key]) for key in one)


@pytest.mark.parametrize("context", ["live", "detached"])
def test_deeper_predictions_are_normalised_as_in_planning(context):
    """In train mode too: one clip decides on its own predictions beyond depth 1, by the statistics after this step."""
    loss, clip = make_loss("paper", 0.0, prediction_steps=3), make_clip(frames=5)
    clip = loss._read(clip)
    latent = loss._encode(clip)
    params = with_own_buffers(loss.predictor_params) if context == "detached" else None
    loss._rollout(clip, latent, 1)
    before = {name: value.clone() for name, value in loss.predictor.named_buffers()}
    rollout = loss._rollout(clip, latent, 3, params)
    moved = any(not value.equal(before[name]) for name, value in loss.predictor.named_buffers())
    assert loss.predictor.training and moved == (params is None)
    predictor = loss.eval().predictor.module
    for start in range(4):
        path = torch.cat([latent[:, : start + 1], rollout[0][:, start : start + 1]], 1)
        for depth in range(2, min(3, 4 - start) + 1):
            rows = slice(max(0, start + depth - 2), start + depth)
            path = torch.cat([path, predictor(path[:, rows], clip.action[:, rows])[:, -1:]], 1)
            torch.testing.assert_close(rollout[depth - 1][:, start], path[:, -1])


@each_class
def test_two_batches_may_share_a_backward_pass(name):
    """The first one reads the running statistics that the second one moves."""
    loss = make_loss(name, prediction_steps=3)
    (total(call(loss, make_clip(frames=5))) + total(call(loss, make_clip(frames=5, seed=1)))).backward()


@each_class
def test_clips_of_latents_give_the_same_error_and_teach_the_predictor(name):
    loss, clip = make_loss(name, prediction_steps=3).eval(), make_clip(frames=6).set("mask", make_mask(frames=6))
    latents = clip.exclude("pixels").set("latent", loss.encoder.module(clip["pixels"]).detach())
    torch.testing.assert_close(call(loss, latents)["loss_pred"], call(loss, clip)["loss_pred"])
    found = gradients(loss.train(), latents, "loss_pred")
    assert all(grad is None for grad in found["encoder"])
    assert sum(grad.norm() for grad in found["predictor"]) > 0


def test_an_inverse_model_with_a_history_reads_windows_of_it():
    loss, clip = make_loss("transformer", idm_coeff=1.0, reduction="none").eval(), make_clip(frames=5)
    real = loss.encoder.module(clip["pixels"])
    output = call(loss, clip)["loss_idm"]  # [B, 4]
    for at in range(4):
        rows = slice(max(0, at - 1), at + 1)
        recovered = loss.inverse_model.module(real[:, rows], real[:, 1:][:, rows])[:, -1]
        torch.testing.assert_close(output[:, at], (recovered - clip["action"][:, at]).square().mean(-1))


def test_a_predictor_without_a_history_reads_all_frames_before():
    class Mean(nn.Linear):
        def forward(self, latent, action):
            assert latent.ndim == 3
            count = torch.arange(1, latent.shape[-2] + 1).unsqueeze(-1)
            return super().forward(torch.cat([latent.cumsum(-2) / count, action], -1))

    predictor = TensorDictModule(Mean(LATENT + BLOCK, LATENT), ["latent", "action"], ["predicted_latent"])
    loss = LeWMLoss(make_networks()[0], predictor, sigreg=SIGReg(4), prediction_steps=3).eval()
    clip = make_clip(frames=5)
    real, errors = loss.encoder.module(clip["pixels"]), [[] for _ in range(4)]
    for start in range(4):
        path = real[:, : start + 1]
        for at in range(start, min(start + 3, 4)):
            path = torch.cat([path, predictor.module(path, clip["action"][:, : at + 1])[:, -1:]], 1)
            errors[at].append((path[:, -1] - real[:, at + 1]).square().mean())
    expected = torch.stack([torch.stack(each).mean() for each in errors]).mean()
    torch.testing.assert_close(call(loss, clip)["loss_pred"], expected)


# Refusals


@each_class
def test_clips_that_are_too_short_and_depths_below_one_are_refused(name):
    clip = make_clip(frames=3)
    latents = TensorDict({"latent": torch.randn(8, 3, LATENT), "action": clip["action"]}, [8, 3])
    for each in (clip, latents):
        with pytest.raises(ValueError, match="prediction_steps=3 needs clips of 4 frames, got 3: sample longer clips"):
            make_loss(name, prediction_steps=3)(each)
    for steps in (0, 1.5):
        with pytest.raises(ValueError, match=f"prediction_steps must be a positive whole number, got {steps}"):
            make_loss(name, prediction_steps=steps)
