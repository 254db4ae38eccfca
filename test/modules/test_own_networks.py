"""Networks of a user's own, a plain module or a sequence, train, save, load, plan and are evaluated as ours do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import CEMConfig, FICRegLoss, LatentCEMPlanner, LatentWorldModel, LeWMLoss, MPCPolicy
from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.evaluation import evaluate_mpc, StartGoalPairs
from torchrl_ficreg.pretrained import ModelCard, save_pretrained
from torchrl_ficreg.trainers import checkpoint_components, load_world_model, OfflineTrainer

D, F, A = 6, 2, 2  # width of a latent, frame skip, actions
BOX = ([-1.0, -1.0], [1.0, 1.0])


class Linear(nn.Module):
    """A linear layer on its inputs side by side; it knows no size by the names of ours."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.layer = nn.Linear(width, out)

    def forward(self, *inputs):
        return self.layer(torch.cat(inputs, -1))


class Pixels(Linear):
    """Frames [..., 3, 16, 16] -> [..., D]."""

    def forward(self, pixels):
        return self.layer(pixels.flatten(-3) / 255)


def plain() -> TensorDictModule:
    return TensorDictModule(Linear(D + F * A, D), ["latent", "action"], ["predicted_latent"])


def sequence() -> TensorDictSequential:
    """Reads action before latent, and writes what the losses do not ask for."""
    embed = TensorDictModule(Linear(F * A, 8), ["action"], ["embedding"])
    return TensorDictSequential(embed, TensorDictModule(Linear(8 + D, D), ["embedding", "latent"], ["predicted_latent"]))


def make_networks(predictor) -> tuple[LatentWorldModel, TensorDictModule]:
    torch.manual_seed(0)
    encoder = TensorDictModule(Pixels(3 * 16**2, D), ["pixels"], ["latent"])
    model = LatentWorldModel(encoder, predictor(), frame_skip=F, latent_dim=D, action_dim=F * A, history=2)
    return model, TensorDictModule(Linear(2 * D, F * A), ["latent", "next_latent"], ["recovered_action"])


def make_data() -> OfflineTrajectories:
    rng = np.random.default_rng(0)
    episodes = [
        {
            "pixels": rng.integers(0, 256, (16, 3, 16, 16), dtype=np.uint8),
            "action": np.pad(rng.uniform(-1, 1, (15, A)), ((0, 1), (0, 0))).astype(np.float32),
            "state": rng.normal(size=(16, 2)),
        }
        for _ in range(4)
    ]
    return OfflineTrajectories.from_episodes(episodes, split="all", num_frames=3, frame_skip=F, batch_size=8)


def make_policy(model: LatentWorldModel) -> MPCPolicy:
    config = CEMConfig(num_candidates=8, num_elites=2, iterations=2, horizon=2, receding_horizon=1)
    return MPCPolicy(LatentCEMPlanner(model.eval(), config, action_bounds=BOX))


@pytest.fixture(params=[plain, sequence])
def predictor(request):
    return request.param


@pytest.mark.parametrize("method", ["lewm", "ficreg"])
def test_they_train_with_the_losses(predictor, method):
    model, inverse_model = make_networks(predictor)
    networks = [model.encoder, model.predictor] + ([inverse_model] if method == "ficreg" else [])
    loss = {"lewm": LeWMLoss, "ficreg": FICRegLoss}[method](*networks)
    output = loss(make_data().sample())
    sum(value for name, value in output.items() if name.startswith("loss_")).backward()
    assert all(param.grad.abs().sum() > 0 for param in loss.parameters())


@pytest.fixture(scope="module", params=[plain, sequence])
def trained(request, tmp_path_factory):
    """A run directory, the networks trained in it, and a function that builds them anew."""
    run_dir, data = tmp_path_factory.mktemp("own") / "run", make_data()
    model, inverse_model = make_networks(request.param)
    model.statistics = data.statistics
    card = ModelCard({"image_size": 16}, "two_room", {}, *BOX, config={})
    OfflineTrainer(
        FICRegLoss(model.encoder, model.predictor, inverse_model),
        data,
        epochs=1,
        run_dir=run_dir,
        components=checkpoint_components(model, inverse_model, card),
        progress_bar=False,
    ).train()
    return run_dir, (model, inverse_model), lambda: make_networks(request.param)


def same(first: nn.Module, second: nn.Module) -> bool:
    one, other = first.state_dict(), second.state_dict()
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_a_checkpoint_is_loaded_into_networks_built_anew(trained):
    """With their action statistics; with or without the inverse model."""
    run_dir, (model, inverse_model), make = trained
    fresh, fresh_inverse = make()
    assert not same(fresh, model)
    loaded, loaded_inverse, card = load_world_model(run_dir, world_model=fresh, inverse_model=fresh_inverse)
    assert loaded is fresh and loaded_inverse is fresh_inverse and not loaded.training and card.env == "two_room"
    assert same(loaded, model) and same(loaded_inverse, inverse_model)
    alone, none, _ = load_world_model(run_dir, world_model=make()[0])
    assert none is None and same(alone, model)


def test_networks_that_a_card_cannot_describe_are_refused_with_the_way_out(trained, tmp_path):
    run_dir, (model, inverse_model), _ = trained
    with pytest.raises(ValueError, match=r"own are loaded by load_world_model\(path, world_model=...\)") as caught:
        load_world_model(run_dir)
    assert "\n" not in str(caught.value)
    other, _ = make_networks(lambda: TensorDictModule(Linear(3, D), ["latent", "action"], ["predicted_latent"]))
    with pytest.raises(ValueError, match="of another shape: .*predictor"):
        load_world_model(run_dir, world_model=other)
    with pytest.raises(ValueError, match="give world_model too"):
        load_world_model(run_dir, inverse_model=inverse_model)
    with pytest.raises(TypeError, match="only the package's own networks"):
        save_pretrained(model, tmp_path)


def test_a_loaded_model_is_evaluated_and_plans_as_the_trained_one(trained):
    run_dir, (model, _), make = trained
    loaded, _, _ = load_world_model(run_dir, world_model=make()[0])
    start, goal = np.array([[60.0, 60.0]]), np.array([[60.0, 140.0]])
    whose = {"env": "two_room", "goal_offset": 5, "seed": 0, "fingerprint": "f" * 64}
    pairs = StartGoalPairs(**whose, episode=np.ones(1, int), step=np.zeros(1, int), start_state=start, goal_state=goal)
    settings = {"budget": 4, "image_size": 16, "record": 1, "progress_bar": False}
    ours, theirs = (evaluate_mpc(make_policy(each), pairs, **settings) for each in (loaded, model))
    assert ours.success.shape == (1, 5) and not ours.at_start.any()
    assert np.array_equal(ours.frames[0], theirs.frames[0])
