"""Claims about refinement: the encoder does not change, the prediction error falls, a checkpoint knows whether it is done."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny import make_data, SIZES

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model
from torchrl_ficreg.data.latents import encode_episodes, LatentClips
from torchrl_ficreg.keys import ACTION, LATENT, PIXELS
from torchrl_ficreg.trainers import Refinement


@pytest.fixture
def networks():
    torch.manual_seed(0)
    model, inverse_model = make_world_model(SIZES, action_dim=2)
    return model.eval(), inverse_model


@pytest.fixture
def clips(networks):
    data = make_data(num_frames=2)
    return LatentClips(data, encode_episodes(data, networks[0].encode))


def test_clips_of_latents_are_those_of_the_frames(networks):
    """Every start once, the blocks between the frames z-scored and time-major, none across an episode's end."""
    data, model = make_data(num_frames=3, batch_size=None), networks[0]
    drawn = LatentClips(data, encode_episodes(data, model.encode))
    assert len(drawn) == len(data)
    batch = drawn.sample(64, generator=torch.Generator().manual_seed(0))
    whole = data[torch.arange(len(data))]
    reference = model.encode(whole[PIXELS])  # [M, 3, D]
    for latent, action in zip(batch[LATENT], batch[ACTION]):
        row = (reference - latent).abs().amax((-1, -2)).argmin()
        torch.testing.assert_close(reference[row], latent, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(whole[ACTION][row, :-1], action[:-1])
        assert (action[-1] == 0).all()


@pytest.mark.parametrize("loss_class", [FICRegLoss, LeWMLoss])
def test_the_encoder_does_not_change_and_the_prediction_error_falls(networks, clips, loss_class):
    model, inverse_model = networks
    loss = loss_class(model.encoder, model.predictor, *(inverse_model,) * (loss_class is FICRegLoss))
    before = {name: value.clone() for name, value in model.state_dict().items()}

    def error() -> float:
        model.eval()
        batch = clips.sample(512, generator=torch.Generator().manual_seed(1))
        predicted = model.predict(batch[LATENT][:, :1], batch[ACTION][:, :1])
        return (predicted - batch[LATENT][:, 1:]).square().mean().item()

    start = error()
    refinement = Refinement(60, batch_size=64, lr=3e-3, precision="fp32")
    assert not refinement.done
    refinement.run(loss, clips, progress_bar=False)
    assert refinement.done and refinement.seconds > 0
    assert error() < 0.8 * start
    moved = {name.split(".")[0] for name, value in model.state_dict().items() if not value.equal(before[name])}
    assert moved == {"predictor"}


def test_its_steps_are_those_of_adamw_on_sampled_clips(networks, clips):
    """By hand: five updates on clips that one generator draws, warm-up and cosine over these five steps."""
    model, inverse_model = networks
    loss = FICRegLoss(model.encoder, model.predictor, inverse_model).train()
    start = {name: value.clone() for name, value in loss.state_dict().items()}
    params = [p for p in loss.parameters() if p.requires_grad]
    optimizer, generator = torch.optim.AdamW(params, lr=1e-3, weight_decay=1e-3, fused=True), torch.Generator().manual_seed(7)
    torch.manual_seed(1)
    for factor in (1.0, 1.0, 0.85355339, 0.5, 0.14644661):
        optimizer.param_groups[0]["lr"] = 1e-3 * factor
        sum(loss(clips.sample(16, generator=generator)).values()).backward()
        torch.nn.utils.clip_grad_norm_(params, 1.0)
        optimizer.step()
        optimizer.zero_grad()
    expected = [p.detach().clone() for p in params]
    loss.load_state_dict(start)
    torch.manual_seed(1)
    Refinement(5, batch_size=16, precision="fp32", seed=7).run(loss, clips, progress_bar=False)
    torch.testing.assert_close([p.detach() for p in params], expected, rtol=1e-4, atol=1e-6)


def test_a_checkpoint_knows_whether_it_was_done():
    first, second = Refinement(10), Refinement(10)
    first.done, first.seconds = True, 3.0
    second.load_state_dict(first.state_dict())
    assert second.done and second.seconds == 3.0
    assert Refinement(0).done


def test_a_loss_that_stops_being_finite_is_named(networks, clips):
    model, _ = networks
    next(model.predictor.parameters()).data.fill_(np.nan)
    loss = LeWMLoss(model.encoder, model.predictor)
    with pytest.raises(FloatingPointError, match="refinement, step 1: not finite: loss_pred=nan"):
        Refinement(2, batch_size=8, precision="fp32").run(loss, clips, progress_bar=False)


@pytest.mark.parametrize("wrong", [{"steps": -1}, {"steps": 1, "batch_size": 1}, {"steps": 1, "lr": 0.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="a refinement needs steps of at least 0"):
        Refinement(**wrong)
