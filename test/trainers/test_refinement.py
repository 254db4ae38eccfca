"""Claims about the last phase on frozen latents: the encoder stands still, the predictor gets better, runs resume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny import make_data, SIZES

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model
from torchrl_ficreg.data.latents import encode_episodes, LatentClips
from torchrl_ficreg.keys import ACTION, LATENT, PIXELS
from torchrl_ficreg.trainers import NoRegularizer, on_frozen_latents, Refinement


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
    assert len(drawn) == data.num_clips
    batch = drawn.sample(64, generator=torch.Generator().manual_seed(0))
    whole = data[torch.arange(data.num_clips)]
    reference = model.encode(whole[PIXELS])  # [M, 3, D]
    for latent, action in zip(batch[LATENT], batch[ACTION]):
        row = (reference - latent).abs().amax((-1, -2)).argmin()
        torch.testing.assert_close(reference[row], latent, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(whole[ACTION][row, :-1], action[:-1])
        assert (action[-1] == 0).all()


@pytest.mark.parametrize("loss_class", [FICRegLoss, LeWMLoss])
def test_the_encoder_stands_still_and_the_prediction_error_falls(networks, clips, loss_class):
    model, inverse_model = networks
    extra = (inverse_model,) if loss_class is FICRegLoss else ()
    frozen = on_frozen_latents(model)
    loss = loss_class(frozen.encoder, frozen.predictor, *extra, sigreg=NoRegularizer())
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
    after = model.state_dict()
    moved = {name.split(".")[0] for name in before if not after[name].equal(before[name])}
    assert moved == {"predictor"}


def test_the_same_seed_gives_the_same_weights(networks, clips):
    results = []
    for _ in range(2):
        torch.manual_seed(0)
        model, inverse_model = make_world_model(SIZES, action_dim=2)
        frozen = on_frozen_latents(model)
        loss = FICRegLoss(frozen.encoder, frozen.predictor, inverse_model, sigreg=NoRegularizer())
        Refinement(5, batch_size=16, precision="fp32").run(loss, clips, progress_bar=False)
        results.append(torch.cat([p.flatten() for p in model.predictor.parameters()]))
    assert results[0].equal(results[1])


def test_a_checkpoint_knows_whether_it_was_done():
    first, second = Refinement(10), Refinement(10)
    first.done, first.seconds = True, 3.0
    second.load_state_dict(first.state_dict())
    assert second.done and second.seconds == 3.0
    assert Refinement(0).done


def test_a_loss_that_stops_being_finite_is_named(networks, clips):
    frozen = on_frozen_latents(networks[0])
    next(frozen.predictor.parameters()).data.fill_(np.nan)
    loss = LeWMLoss(frozen.encoder, frozen.predictor, sigreg=NoRegularizer())
    with pytest.raises(FloatingPointError, match="refinement step 0: not finite"):
        Refinement(2, batch_size=8, precision="fp32").run(loss, clips, progress_bar=False)


@pytest.mark.parametrize("wrong", [{"steps": -1}, {"steps": 1, "batch_size": 1}, {"steps": 1, "lr": 0.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="a refinement needs steps of at least 0"):
        Refinement(**wrong)
