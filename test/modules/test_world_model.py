"""Claims about the world model: its rollout is predict() applied again and again, and its statistics travel along."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import LatentWorldModel
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


class Own(nn.Module):
    """A predictor that knows the sizes that it is given."""

    def __init__(self, **sizes):
        super().__init__()
        self.layer = nn.Linear(10, 6)
        vars(self).update(sizes)

    def forward(self, latent, action):
        return self.layer(torch.cat([latent, action], -1))


SIZES = {"history": 2, "latent_dim": 6, "action_dim": 4}


def with_predictor(predictor, **kwargs):
    encoder = TensorDictModule(nn.Identity(), ["pixels"], ["latent"])
    return LatentWorldModel(encoder, predictor, **{"frame_skip": 2, **kwargs}).eval()


def own(**sizes):
    return TensorDictModule(Own(**sizes), ["latent", "action"], ["predicted_latent"])


@pytest.mark.parametrize("sequence", [False, True])
@pytest.mark.parametrize("said_by", ["arguments", "attributes", "both"])
def test_sizes_come_from_the_predictor_or_from_arguments(said_by, sequence):
    """Those of a network may stand in it or in the module that wraps it; the rollout is that of predict()."""
    predictor = own(**({} if said_by == "arguments" or sequence else SIZES))
    if sequence:
        predictor = TensorDictSequential(predictor)
        vars(predictor).update({} if said_by == "arguments" else SIZES)
    model = with_predictor(predictor, **({} if said_by == "attributes" else SIZES))
    assert (model.latent_dim, model.block_dim, model.history) == (6, 4, 2)
    latent, action = torch.randn(3, 1, 6), torch.randn(3, 4, 4)
    torch.testing.assert_close(model.rollout(latent, action), by_hand(model, latent, action))


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({}, TypeError, r"the predictor has no attribute {0}: give it one, or LatentWorldModel\(..., {0}=\)"),
        ({"given": 8, "said": 4}, ValueError, "{0}=8 differs from {0}=4 of the predictor"),
        ({"given": 0}, ValueError, "{0} must be a positive integer, got 0"),
        ({"said": 2.0}, ValueError, "{0} must be a positive integer, got 2.0"),
        ({"given": True}, ValueError, "{0} must be a positive integer, got True"),
    ],
)
def test_sizes_that_are_missing_or_contradict_each_other_are_refused(name, change, error, message):
    said = {**SIZES, name: change.get("said")}
    with pytest.raises(error, match=message.format(name)):
        with_predictor(own(**said), **{name: change.get("given")})


def test_a_plain_module_and_a_frame_skip_that_is_none_are_refused():
    with pytest.raises(TypeError, match="the predictor must be a TensorDictModule, got a Own: wrap a network as"):
        with_predictor(Own(**SIZES))
    for wrong in (0, -2, 2.0):
        with pytest.raises(ValueError, match="frame_skip must be a positive integer, got"):
            with_predictor(own(**SIZES), frame_skip=wrong)


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


def a_clip(batch_size):
    frames = torch.randint(0, 256, (4, 3, 3, 16, 16), dtype=torch.uint8)
    return TensorDict({"pixels": frames, "action": torch.randn(4, 3, 4), "reward": torch.randn(4, 3, 1)}, batch_size)


@pytest.mark.parametrize("batch_size", [[], [4], [4, 3]])
def test_forward_encodes_and_predicts_and_keeps_every_other_entry(tiny_world, batch_size):
    """In place, but where the batch size counts the frames, of which one has no prediction."""
    model, clip = tiny_world(history=2), a_clip(batch_size)
    before = clip.clone()
    output = model(clip)
    assert set(output.keys()) == {*before.keys(), "latent", "predicted_latent"}
    assert all(output[key].equal(before[key]) for key in before.keys())
    torch.testing.assert_close(output["latent"], model.encode(clip["pixels"]))
    expected = model.predict(output["latent"][:, :-1], clip["action"][:, :-1])
    torch.testing.assert_close(output["predicted_latent"], expected)
    if batch_size == [4, 3]:
        assert output.batch_size == (4,) and set(clip.keys()) == set(before.keys()) and clip.batch_size == (4, 3)
    else:
        assert output is clip


def test_a_world_model_works_in_a_sequence_and_by_keyword(tiny_world):
    model, clip = tiny_world(history=2), a_clip([4, 3])
    error = TensorDictModule(
        lambda latent, predicted: (latent[:, 1:] - predicted).square().sum(-1), ["latent", "predicted_latent"], ["error"]
    )
    output = TensorDictSequential(model, error)(clip)
    assert output["error"].shape == (4, 2) and output["reward"].equal(clip["reward"])
    latent, predicted = model(pixels=clip["pixels"], action=clip["action"])
    assert latent.equal(output["latent"]) and predicted.equal(output["predicted_latent"])


def test_keys_can_be_renamed_nested_too(tiny_world):
    """By the constructor and by ``set_keys``, whatever the keys of the networks are."""
    model, clip = tiny_world(history=2), a_clip([4])
    expected = model(clip.clone())
    keys = {"pixels": ("camera", "rgb"), "action": "u", "latent": ("next", "z"), "predicted_latent": ("next", "guess")}
    names = list(keys.values())
    model.set_keys(**keys)
    built = LatentWorldModel(model.encoder, model.predictor, frame_skip=2, in_keys=names[:2], out_keys=names[2:]).eval()
    renamed = clip.rename_key_("pixels", keys["pixels"]).rename_key_("action", "u")
    for renamed_model in (model, built):
        assert (renamed_model.in_keys, renamed_model.out_keys) == (names[:2], names[2:])
        output = renamed_model(renamed.clone())
        assert output["next", "z"].equal(expected["latent"])
        assert output["next", "guess"].equal(expected["predicted_latent"])
    model.set_keys(pixels=None)
    assert model.in_keys == ["pixels", "u"]
    with pytest.raises(ValueError, match="no key reward: set_keys changes pixels, action, latent, predicted_latent"):
        model.set_keys(reward="r")
    with pytest.raises(RuntimeError, match="key should be a"):
        model.set_keys(pixels="image", action=3)
    assert model.in_keys == [model.tensor_keys.pixels, model.tensor_keys.action] == ["pixels", "u"]
    with pytest.raises(ValueError, match=r"in_keys \[pixels, action\] and out_keys \[latent, predicted_latent\], got"):
        LatentWorldModel(model.encoder, model.predictor, frame_skip=2, in_keys=["pixels"])


def test_renaming_what_is_written_selects_no_other_output(tiny_world):
    """Of networks that write several entries; the entry is the one of the new name only where they write it."""
    model, clip = tiny_world(history=2), a_clip([4])
    expected = model(clip.clone())
    model = LatentWorldModel(
        *(
            TensorDictModule(lambda *inputs, of=of: (out := of(*inputs), out + 1), keys, [*of.out_keys, "other"])
            for of, keys in ((model.encoder, ["pixels"]), (model.predictor, ["latent", "action"]))
        ),
        frame_skip=2,
        **SIZES,
    ).eval()
    for keys in ({}, {"latent": ("agent", "z"), "predicted_latent": "guess"}):
        model.set_keys(**keys)
        output = model(clip.clone())
        for key, name in zip(("latent", "predicted_latent"), model.out_keys):
            torch.testing.assert_close(output[name], expected[key])
    model.set_keys(latent="other")
    torch.testing.assert_close(model.encode(clip["pixels"]), expected["latent"] + 1)
    unnamed = LatentWorldModel(
        TensorDictModule(lambda x: (x, x), ["pixels"], ["code", "other"]), model.predictor, frame_skip=2, **SIZES
    )
    with pytest.raises(KeyError, match=r"no 'latent' among \['code', 'other'\], what the network writes: see set_keys"):
        unnamed.encode(clip["pixels"])


def test_a_lazy_stack_of_clips_is_read_as_a_batch(tiny_world):
    model, clip = tiny_world(history=2), a_clip([4, 3])
    output = model(TensorDict.lazy_stack(list(clip)))
    expected = model(clip)
    assert output.batch_size == (4,) and set(output.keys()) == set(expected.keys())
    torch.testing.assert_close(output["predicted_latent"], expected["predicted_latent"])


def test_statistics_are_part_of_the_state_and_copied_not_borrowed(tiny_world):
    model, fresh, mean = tiny_world(), tiny_world(), torch.tensor([1.0, -2.0])
    model.statistics = ActionStatistics(mean, torch.tensor([0.5, 3.0]))
    mean.zero_()
    fresh.load_state_dict(model.state_dict())
    assert fresh.statistics.mean.tolist() == [1.0, -2.0] and fresh.statistics.std.tolist() == [0.5, 3.0]


@pytest.mark.parametrize(
    ("use", "error", "message"),
    [
        (lambda model: model(a_clip([4]).exclude("action")), KeyError, "the world model reads 'action', which is missing"),
        (lambda model: model.rollout(torch.zeros(2, 1, 6), torch.zeros(2, 2, 2)), ValueError, "4 wide .* got 2"),
        (
            lambda model: setattr(model, "statistics", ActionStatistics(torch.zeros(5), torch.ones(5))),
            ValueError,
            "acts in 2 dimensions, the statistics have 5",
        ),
        (
            lambda model: LatentWorldModel(model.encoder, model.predictor, frame_skip=3),
            ValueError,
            "width 4 is no multiple of frame_skip 3",
        ),
    ],
)
def test_what_does_not_fit_a_world_model_is_refused(tiny_world, use, error, message):
    with pytest.raises(error, match=message):
        use(tiny_world())
