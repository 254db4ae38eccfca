"""Claims about the world model: its rollout is predict() applied again and again, and its statistics travel along."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import CausalPredictor, ConvEncoder, LatentCEMPlanner, LatentWorldModel, PlanConfig
from torchrl_ficreg.data import ActionStatistics


def by_hand(model, latent, action):
    """One predict() call per step on the last H latents and the blocks that lead on from them."""
    latents = list(latent.unbind(-2))
    for end in range(latent.shape[-2], action.shape[-2] + 1):
        window = slice(max(0, end - model.history), end)
        latents.append(model.predict(torch.stack(latents[window], -2), action[..., window, :])[..., -1, :])
    return torch.stack(latents[latent.shape[-2] :], -2)


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("context", [1, 3, 5])
@pytest.mark.parametrize("history", [1, 3])
def test_a_rollout_is_a_loop_of_predictions(tiny_world, history, context, lead):
    """The window grows from the context to H and then slides."""
    model = tiny_world(history=history)
    latent, action = torch.randn(*lead, context, 6), torch.randn(*lead, context - 1 + 5, 4)
    imagined = model.rollout(latent, action)
    assert imagined.shape == (*lead, 5, 6)
    torch.testing.assert_close(imagined, by_hand(model, latent, action))


def test_the_first_imagined_step_is_the_prediction_trained_for(tiny_world):
    model = tiny_world()
    latent, action = torch.randn(2, 3, 6), torch.randn(2, 3, 4)
    torch.testing.assert_close(model.rollout(latent, action)[:, 0], model.predict(latent, action)[:, -1])


class Own(nn.Module):
    """A predictor with a constant of its own in float32, which no cast of its parameters reaches."""

    def __init__(self, **sizes):
        super().__init__()
        self.layer = nn.Linear(10, 6)
        vars(self).update(sizes)

    def forward(self, latent, action):
        return self.layer(torch.cat([latent + torch.linspace(0, 1, 6, dtype=torch.float32), action], -1))


SIZES = {"history": 2, "latent_dim": 6, "action_dim": 4}


def with_predictor(predictor, **kwargs):
    encoder = TensorDictModule(nn.Identity(), ["pixels"], ["latent"])
    return LatentWorldModel(encoder, predictor, **{"frame_skip": 2, **kwargs}).eval()


def test_a_predictor_of_ones_own_says_its_sizes_itself_or_in_its_network():
    """In a single module or in a sequence of them; the rollout is the same."""
    network = Own(**SIZES)
    single = with_predictor(TensorDictModule(network, ["latent", "action"], ["predicted_latent"]))
    sequence = TensorDictSequential(TensorDictModule(network, ["latent", "action"], ["predicted_latent"]))
    vars(sequence).update(SIZES)
    latent, action = torch.randn(3, 1, 6), torch.randn(3, 4, 4)
    expected = single.rollout(latent, action)
    assert with_predictor(sequence).rollout(latent, action).equal(expected)
    torch.testing.assert_close(expected, by_hand(single, latent, action))


@pytest.mark.parametrize("missing", SIZES)
def test_a_predictor_without_sizes_is_told_which(missing):
    network = Own(**{name: size for name, size in SIZES.items() if name != missing})
    with pytest.raises(TypeError, match=f"a predictor of your own says .*: give it, or its network, {missing}"):
        with_predictor(TensorDictModule(network, ["latent", "action"], ["predicted_latent"]))


def test_a_plain_module_and_a_frame_skip_that_is_none_are_refused():
    with pytest.raises(TypeError, match="the predictor must be a TensorDictModule, got a Own: wrap a network as"):
        with_predictor(Own(**SIZES))
    predictor = TensorDictModule(Own(**SIZES), ["latent", "action"], ["predicted_latent"])
    for wrong in (0, -2, 2.0):
        with pytest.raises(ValueError, match="frame_skip must be a whole number of at least 1 action, got"):
            with_predictor(predictor, frame_skip=wrong)


def test_left_to_choose_a_planner_does_not_cast_a_network_of_ones_own(monkeypatch):
    """Wherever bfloat16 is fast: it may not bear the rounding, or, as here, the cast. A network of the package does."""
    monkeypatch.setattr("torchrl_ficreg.planners.base.uses_bf16", lambda device, chosen: chosen != "fp32")
    settings = {"num_candidates": 8, "num_elites": 2, "iterations": 2}
    model = with_predictor(TensorDictModule(Own(**SIZES), ["latent", "action"], ["predicted_latent"]))
    plans = [
        LatentCEMPlanner(model, PlanConfig(**settings, precision=precision), action_bounds=([-1, -1], [1, 1])).plan(
            torch.zeros(2, 6), torch.ones(2, 6)
        )
        for precision in ("auto", "fp32")
    ]
    assert plans[0]["plan"].equal(plans[1]["plan"])
    predictor = CausalPredictor(latent_dim=6, action_dim=4, history=1, depth=1)
    assert LatentCEMPlanner(with_predictor(predictor), PlanConfig(bounds="none"))._wants_bf16_copy()


def test_a_rollout_is_differentiable_in_its_actions(tiny_world):
    """What a gradient planner needs: every block moves the last latent."""
    action = torch.randn(2, 4, 4, requires_grad=True)
    tiny_world().rollout(torch.randn(2, 1, 6), action)[:, -1].sum().backward()
    assert (action.grad.abs().sum(-1) > 0).all()


@pytest.mark.parametrize(
    ("latent", "action"),
    [
        ((2, 3, 6), (2, 2, 4)),  # nothing left to imagine
        ((2, 0, 6), (2, 2, 4)),  # no context
        ((2, 1, 6), (3, 2, 4)),  # other rows
        ((2, 1, 5), (2, 2, 4)),  # another latent
        ((2, 1, 1), (2, 2, 4)),  # would broadcast
        ((6,), (2, 4)),
    ],
)
@pytest.mark.parametrize("width", [6, 8])
def test_a_rollout_of_other_shapes_is_refused(tiny_world, latent, action, width):
    model = tiny_world(predictor_width=width, predictor_dim_head=width // 2)
    with pytest.raises(ValueError, match=r"rollout takes latents \[..., C, 6\] and C - 1 \+ N action blocks"):
        model.rollout(torch.zeros(latent), torch.zeros(action))


def test_a_rollout_with_blocks_of_another_width_is_refused(tiny_world):
    with pytest.raises(ValueError, match="4 wide .* got 2"):
        tiny_world().rollout(torch.zeros(2, 1, 6), torch.zeros(2, 2, 2))


def test_forward_encodes_and_predicts_and_leaves_its_input_alone(tiny_world):
    model = tiny_world(history=2)
    pixels = torch.randint(0, 256, (4, 3, 3, 16, 16), dtype=torch.uint8)
    clip = TensorDict({"pixels": pixels, "action": torch.randn(4, 3, 4)}, [4, 3])
    before = clip.clone()
    output = model(clip)
    assert set(clip.keys()) == {"pixels", "action"}
    assert (clip == before).all()
    assert set(output.keys()) == {"latent", "predicted_latent"}
    torch.testing.assert_close(output["latent"], model.encode(pixels))
    expected = model.predict(output["latent"][:, :-1], clip["action"][:, :-1])
    torch.testing.assert_close(output["predicted_latent"], expected)


def test_statistics_are_part_of_the_state(tiny_world):
    model, fresh = tiny_world(), tiny_world()
    model.statistics = ActionStatistics(torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0]))
    fresh.load_state_dict(model.state_dict())
    assert fresh.statistics.mean.tolist() == [1.0, -2.0]
    assert fresh.statistics.std.tolist() == [0.5, 3.0]


def test_statistics_are_copied_not_borrowed(tiny_world):
    model, mean = tiny_world(), torch.tensor([1.0, -2.0])
    model.statistics = ActionStatistics(mean, torch.ones(2))
    mean.zero_()
    assert model.statistics.mean.tolist() == [1.0, -2.0]


def test_statistics_of_another_environment_are_refused(tiny_world):
    with pytest.raises(ValueError, match="acts in 2 dimensions, the statistics have 5"):
        tiny_world().statistics = ActionStatistics(torch.zeros(5), torch.ones(5))


def test_a_block_that_is_no_multiple_of_the_frame_skip_is_refused():
    predictor = CausalPredictor(latent_dim=16, action_dim=10, depth=1)
    with pytest.raises(ValueError, match="width 10 is no multiple of frame_skip 3"):
        LatentWorldModel(ConvEncoder(), predictor, frame_skip=3)
