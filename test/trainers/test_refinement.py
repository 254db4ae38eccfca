"""Claims about training on latents of a frozen encoder: the clips, what changes, resuming, the record in a checkpoint."""

from __future__ import annotations

import pytest
import torch
from tiny import make_data, SIZES

from torchrl_ficreg import FICRegLoss, LeWMLoss, make_world_model
from torchrl_ficreg.data.latents import encode_episodes
from torchrl_ficreg.keys import ACTION, LATENT, MASK, PIXELS
from torchrl_ficreg.trainers import OfflineTrainer, Refinement


@pytest.fixture
def networks():
    torch.manual_seed(0)
    model, inverse_model = make_world_model(SIZES, action_dim=2)
    return model.eval(), inverse_model


@pytest.fixture
def latent(networks):
    return encode_episodes(make_data(), networks[0].encode)


@pytest.mark.parametrize("split, num_frames", [("train", 3), ("validation", 2), ("all", 4)])
def test_clips_of_latents_are_those_of_the_frames(networks, split, num_frames):
    """In the same order, with the same actions; the rows of a split are counted over its own episodes."""
    frames = make_data(split, num_frames=num_frames, seed=3)
    latent = encode_episodes(frames, networks[0].encode)
    clips = make_data(split, num_frames=num_frames, seed=3, latent=latent)
    assert len(clips) == len(frames) and clips.batches_per_epoch == frames.batches_per_epoch
    for _ in range(clips.batches_per_epoch + 1):
        one, other = clips.sample(), frames.sample()
        assert PIXELS not in one and one[LATENT].dtype == torch.float32
        torch.testing.assert_close(one[LATENT], networks[0].encode(other[PIXELS]), rtol=1e-4, atol=1e-5)
        assert torch.equal(one[ACTION], other[ACTION]) and torch.equal(one[MASK], other[MASK])


def test_latents_of_other_rows_are_refused(latent):
    with pytest.raises(ValueError, match=r"have 48 frames, got latents \[168, 4\]: encode the same split"):
        make_data("validation", latent=latent)
    with pytest.raises(KeyError, match="only if they are given"):
        make_data(keys=("latent", "action"))


@pytest.mark.parametrize("loss_class", [FICRegLoss, LeWMLoss])
def test_the_encoder_does_not_change_and_the_prediction_error_falls(networks, latent, loss_class, tmp_path):
    """Stopped after an epoch and resumed, it ends with the weights of an unbroken phase."""
    model, inverse_model = networks
    data, start = make_data(latent=latent), {name: value.clone() for name, value in model.state_dict().items()}

    def train(folder: str, *epochs: int) -> dict[str, torch.Tensor]:
        model.load_state_dict(start)
        torch.manual_seed(0)
        inverse_model.reset_parameters_recursive()
        for end in epochs:
            loss = loss_class(model.encoder, model.predictor, *(inverse_model,) * (loss_class is FICRegLoss))
            settings = {"epochs": end, "schedule_epochs": epochs[-1], "lr": 3e-3, "precision": "fp32", "progress_bar": False}
            data.seek(0)
            trainer = OfflineTrainer(loss, data, run_dir=tmp_path / folder, **settings)
            assert trainer.resume() == (end != epochs[0])
            trainer.train()
        return {name: value.clone() for name, value in model.state_dict().items()}

    def error() -> float:
        batch = make_data("validation", latent=held_out, batch_size=None)[:]
        predicted = model.eval().predict(batch[LATENT][:, :1], batch[ACTION][:, :1])
        return (predicted - batch[LATENT][:, 1:]).square().mean().item()

    held_out = encode_episodes(make_data("validation"), model.encode)
    before, end = error(), train("unbroken", 6)
    assert error() < 0.8 * before
    assert {name.split(".")[0] for name, value in end.items() if not value.equal(start[name])} == {"predictor"}
    resumed = train("resumed", 2, 6)
    assert all(torch.equal(value, resumed[name]) for name, value in end.items())


def test_a_checkpoint_knows_whether_it_was_done():
    first, second = Refinement(done=True, seconds=3.0), Refinement()
    assert not second.done
    second.load_state_dict(first.state_dict())
    assert second == first
