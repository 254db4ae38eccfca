"""Claims about the losses as TorchRL modules: keys, dispatch, state, modes, copies, errors."""

from __future__ import annotations

import copy
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch._subclasses import FakeTensor, FakeTensorMode
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from torchrl_ficreg import (
    CausalPredictor,
    ConvEncoder,
    FICRegLoss,
    InverseDynamicsModel,
    LatentWorldModel,
    LeWMLoss,
    SIGReg,
)
from torchrl_ficreg.modules.layers import check_finite


def values(loss, *args, **kwargs):
    torch.manual_seed(0)
    if hasattr(loss, "sigreg"):
        loss.sigreg.generator_state[1] = 0
    return loss(*args, **kwargs)


@pytest.fixture(params=["lewm", "paper", "joint", "pldm"])
def loss(request, make_loss):
    return make_loss(request.param)


def test_building_a_loss_warns_of_nothing(networks):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FICRegLoss(*networks())


def test_the_clip_is_left_alone(loss, make_clip):
    clip = make_clip()
    clip["mask"] = torch.rand(8, 3) > 0.3
    before = clip.clone()
    sum(values(loss, clip).values()).backward()
    assert set(clip.keys()) == {"pixels", "action", "mask"}
    assert (clip == before).all()


def test_it_can_be_called_by_keyword(loss, make_clip):
    clip = make_clip()
    output = values(loss, **clip)
    assert loss.in_keys == ["pixels", "action"]
    for value, expected in zip(output, (values(loss, clip)[key] for key in loss.out_keys), strict=True):
        assert value.equal(expected)


def test_every_key_can_be_renamed_nested_too(loss, make_clip, make_lewm):
    clip = make_clip()
    clip["mask"] = torch.rand(8, 3) > 0.3
    expected = values(loss.eval(), clip)
    renamed = TensorDict({("obs", "camera", "rgb"): clip["pixels"], ("obs", "control"): clip["action"]}, [8])
    renamed["obs", "trusted"] = clip["mask"]
    loss.set_keys(pixels=("obs", "camera", "rgb"), action=("obs", "control"), mask=("obs", "trusted"))
    assert loss.in_keys == [("obs", "camera", "rgb"), ("obs", "control")]
    torch.testing.assert_close(values(loss, renamed), expected)
    assert make_lewm().in_keys == ["pixels", "action"]  # another loss keeps its names


def test_an_unknown_key_is_refused(loss):
    with pytest.raises(ValueError, match="frames is not an accepted tensordict key"):
        loss.set_keys(frames="pixels")


def test_networks_keep_their_own_key_names(make_ficreg, make_clip):
    """The loss feeds networks by their in_keys and reads their out_keys, whatever these are called."""
    reference, clip = make_ficreg(0.0), make_clip()
    encoder, predictor, inverse_model = (getattr(reference, name).module for name in FICRegLoss._networks)
    loss = FICRegLoss(
        TensorDictModule(encoder, in_keys=[("obs", "rgb")], out_keys=[("belief", "mean")]),
        TensorDictModule(predictor, in_keys=[("belief", "mean"), ("agent", "control")], out_keys=[("next", "belief")]),
        TensorDictModule(inverse_model, in_keys=["before", ("next", "after")], out_keys=[("agent", "guess")]),
        sigreg=SIGReg(16),
    )
    torch.testing.assert_close(values(loss, clip), values(reference, clip))


def _Narrow(in_keys, out_keys, keep=1):
    """A module that keeps so many dimensions of its first input, the last of them 1 wide, for each output."""

    class Narrow(nn.Module):
        def forward(self, *inputs):
            value = inputs[0].float().flatten(keep - 1 if keep > 1 else 0)[..., :1]
            return (value,) * len(out_keys) if len(out_keys) > 1 else value

    return TensorDictModule(Narrow(), list(in_keys), list(out_keys))


class _Add(nn.Linear):
    def forward(self, latent, action):
        return latent + super().forward(action)


class _Flat(nn.Module):
    def forward(self, pixels):
        return pixels.flatten(-3).float() / 255


def test_networks_of_ones_own_need_only_their_keys(make_clip):
    """A sequence of modules as encoder, a linear predictor without BatchNorm or dropout."""
    flat = TensorDictModule(_Flat(), in_keys=["pixels"], out_keys=["flat"])
    code = TensorDictModule(nn.Linear(768, 4), in_keys=["flat"], out_keys=["code"])
    loss = FICRegLoss(
        TensorDictSequential(flat, code, selected_out_keys=["code"]),
        TensorDictModule(_Add(6, 4), in_keys=["code", "action"], out_keys=["next_code"]),
        InverseDynamicsModel(4, 6, 8),
        sigreg=SIGReg(4),
    )
    sum(values(loss, make_clip()).values()).backward()
    assert all(param.grad is not None for param in loss.parameters())


def test_the_constructors_can_rename_keys(make_clip):
    keys = {"in_keys": (("c", "d"), ("e", "f")), "out_key": ("g", "h")}
    loss = FICRegLoss(
        ConvEncoder(image_size=16, channels=(4,), in_key=("a", "b"), out_key=("c", "d"), latent_dim=4),
        CausalPredictor(latent_dim=4, action_dim=6, depth=1, width=8, **keys),
        InverseDynamicsModel(4, 6, 8, in_keys=(("c", "d"), "after"), out_key=("i", "j")),
        sigreg=SIGReg(4),
    )
    assert len(values(loss, make_clip()).keys()) == 4


def test_train_and_eval_reach_the_networks(loss, make_clip):
    networks = [getattr(loss, name) for name in loss._networks]
    assert all(module.training for network in networks for module in network.modules())
    assert loss.eval() is loss
    assert not any(module.training for network in networks for module in network.modules())
    before = copy.deepcopy(loss.state_dict())
    assert values(loss, make_clip())["loss_pred"].equal(values(loss, make_clip())["loss_pred"])
    assert all(value.equal(before[key]) for key, value in loss.state_dict().items())  # no statistic moved
    loss.train()
    assert all(module.training for network in networks for module in network.modules())


def test_the_optimiser_gets_every_parameter_once(loss):
    params = list(loss.parameters())
    expected = [param for name in loss._networks for param in getattr(loss, name).parameters()]
    assert len(params) == len(set(params)) == len(expected)
    assert set(params) == set(expected)  # the networks' own: what is trained is what plans


def test_a_state_dict_carries_everything(make_ficreg, make_clip):
    trained, fresh, clip = make_ficreg(idm_coeff=0.7), make_ficreg(), make_clip()
    optimizer = torch.optim.Adam(trained.parameters(), 0.01)
    sum(values(trained, clip).values()).backward()
    optimizer.step()
    fresh.load_state_dict(trained.state_dict())
    torch.testing.assert_close(values(fresh.eval(), clip), values(trained.eval(), clip), rtol=0, atol=0)
    for name in FICRegLoss._networks:
        ours, theirs = getattr(fresh, name).state_dict(), getattr(trained, name).state_dict()
        assert all(ours[key].equal(theirs[key]) for key in theirs)


def test_a_deep_copy_stands_alone(make_ficreg, make_clip):
    """Training a copy changes its own judge and nothing of the original."""
    original, clip = make_ficreg().eval(), make_clip()
    expected = values(original, clip)
    duplicate = copy.deepcopy(original)
    torch.testing.assert_close(values(duplicate, clip), expected, rtol=0, atol=0)
    with torch.no_grad():
        for param in duplicate.inverse_model_params.parameters():
            param.add_(1.0)
    changed = values(duplicate, clip)
    assert changed["loss_idm"] > 2 * expected["loss_idm"]
    assert changed["loss_consistency"] > 2 * expected["loss_consistency"]
    torch.testing.assert_close(values(original, clip), expected, rtol=0, atol=0)


class _Fails(nn.Linear):
    """A network that runs out of memory, or whatever the error says, at its n-th call."""

    def __init__(self, width_in, width_out, at, error):
        super().__init__(width_in, width_out)
        self.norm, self.at, self.error, self.calls = nn.BatchNorm1d(width_out), at, error, 0

    def forward(self, *inputs):
        self.calls += 1
        if self.calls == self.at:
            raise self.error("here")
        result = super().forward(torch.cat(inputs, -1))
        return self.norm(result.flatten(0, -2)).unflatten(0, result.shape[:-1])


@pytest.mark.parametrize("error", [torch.OutOfMemoryError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("failing", ["predictor", "inverse_model"])
@pytest.mark.parametrize("at", [1, 2])
def test_an_error_inside_leaves_the_networks_usable(networks, make_clip, failing, at, error):
    """Catch, make the batch smaller, go on: no frozen weight and no borrowed buffer stays behind.

    Errors that a signal handler raises in the middle of a forward pass arrive as they are, too.
    """
    encoder, predictor, inverse_model = networks()
    if failing == "predictor":
        predictor = TensorDictModule(_Fails(12, 6, at, error), ["latent", "action"], ["predicted_latent"])
    else:
        inverse_model = TensorDictModule(_Fails(12, 6, at, error), ["latent", "next_latent"], ["recovered_action"])
    loss = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(4))
    network = getattr(loss, failing)
    params, buffers = list(network.parameters()), dict(network.named_buffers())
    with pytest.raises(error, match="here"):
        loss(make_clip())
    assert [id(param) for param in network.parameters()] == [id(param) for param in params]
    assert all(param.requires_grad for param in network.parameters())
    assert all(value.data_ptr() == buffers[key].data_ptr() for key, value in network.named_buffers())
    sum(loss(make_clip()).values()).backward()
    assert all(param.grad is not None for param in params)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda c: c.exclude("pixels"), KeyError, "no 'pixels', only action"),
        (lambda c: c.exclude("action"), KeyError, "no 'action', only pixels"),
        (lambda c: c[:, :1], ValueError, "at least 2 frames"),
        (lambda c: c[0], ValueError, r"pixels \[B, T, 3, H, W\]"),
        (lambda c: c.set("action", c["action"][..., :4]), ValueError, "6 wide .* got 4: check frame_skip"),
        (lambda c: TensorDict({**c, "action": c["action"][:, :2]}, [8]), ValueError, "every frame has an action block"),
        (lambda c: c.set("pixels", c["pixels"].long()), TypeError, "uint8 .* or floating .* got torch.int64"),
        (lambda c: c.set("action", c["action"].long()), TypeError, "actions must be floating.* got torch.int64"),
        (lambda c: c.set("pixels", c["pixels"][..., :8]), ValueError, r"pixels must be \[..., 3, 16, 16\]"),
        (lambda c: torch.cat([c, c], 1), ValueError, "sees 1 to 2 latents, got 5"),
        (lambda c: c.set("mask", torch.ones(8, 3, 2) > 0), ValueError, r"expected \[8, 3\] bool, got \[8, 3, 2\]"),
        (lambda c: TensorDict({**c, "mask": torch.ones(8, 1, dtype=torch.bool)}, [8]), ValueError, r"got \[8, 1\]"),
        (lambda c: c.set("mask", torch.ones(8, 3)), ValueError, "got .* torch.float32"),
        (lambda c: c.set("mask", torch.zeros(8, 3) > 0), ValueError, "the mask leaves no transition"),
        (lambda c: c.set("mask", torch.arange(3).expand(8, 3) > 1), ValueError, "the mask leaves no transition"),
        (lambda c: _poison(c, torch.nan), ValueError, "1 of 16 action blocks hold a NaN or an infinity"),
        (lambda c: _poison(c, torch.inf), ValueError, "1 of 16 action blocks hold a NaN or an infinity"),
        (lambda c: c[:0], ValueError, "the batch of clips is empty"),
        (lambda c: c[:1], ValueError, "B >= 2|at least 2 clips"),
    ],
)
def test_a_wrong_clip_is_refused_and_a_right_one_taken_afterwards(loss, make_clip, change, error, message):
    with pytest.raises(error, match=message):
        loss(change(make_clip()))
    sum(loss(make_clip()).values()).backward()
    assert all(param.grad is not None for param in loss.parameters())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_actions_of_another_precision_are_taken_in_that_of_the_networks(loss, make_clip, dtype):
    """NumPy's default is float64; a float64 network takes float64 actions as they are."""
    clip = make_clip()
    clip["action"] = clip["action"].bfloat16().float()  # exact in all of them
    expected = values(loss.eval(), clip)
    torch.testing.assert_close(values(loss, clip.clone().set("action", clip["action"].to(dtype))), expected)
    assert values(loss.double(), clip.set("action", clip["action"].double()))["loss_pred"].dtype == torch.float64


class _OwnEncoder(nn.Module):
    """One that looks at no value: BatchNorm on the flat frames."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(768), nn.Linear(768, 6))

    def forward(self, pixels):
        return self.net(pixels.flatten(0, -4).float()).unflatten(0, pixels.shape[:-3])


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_pixels_that_are_not_finite_are_refused_before_any_statistic_moves(networks, make_clip, value):
    """By a loss and a world model around any encoder; in a graph that is traced nothing is looked at."""
    _, predictor, inverse_model = networks()
    encoder = TensorDictModule(_OwnEncoder(), ["pixels"], ["latent"])
    loss, clip = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(4)), make_clip()
    clip["pixels"] = clip["pixels"] / 255
    poisoned, before = clip.clone(), {key: value.clone() for key, value in loss.state_dict().items()}
    poisoned["pixels"][3, 1, 0, 2, 5] = value
    model = LatentWorldModel(encoder, predictor, frame_skip=2)
    for door in (loss, model, lambda clip: model.encode(clip["pixels"])):
        with pytest.raises(ValueError, match=r"pixels \[8, 3, 3, 16, 16\] hold a NaN or an infinity"):
            door(poisoned)
        assert all(value.equal(before[key]) for key, value in loss.state_dict().items())
    sum(loss(clip).values()).backward()
    assert all(param.grad.isfinite().all() for param in loss.parameters())
    graph = torch.compile(lambda pixels: check_finite(pixels) or pixels + 1, fullgraph=True, backend="eager")
    assert not graph(poisoned["pixels"]).isfinite().all()


def _poison(clip, value):
    clip["action"][3, 1, 0] = value
    return clip


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"encoder": _Narrow(("pixels",), ("latent",), keep=2)}, ValueError, "the encoder must map pixels"),
        (
            {"encoder": _Narrow(("pixels",), ("latent",), keep=5)},
            ValueError,
            r"the encoder must map pixels \[B, T, 3, H, W\]",
        ),
        (
            {"predictor": _Narrow(("latent", "action"), ("predicted_latent",), keep=3)},
            ValueError,
            r"the shape of its target, got \[8, 2, 1\] for \[8, 2, 6\]",
        ),
        (
            {"inverse_model": _Narrow(("latent", "after"), ("recovered_action",), keep=3)},
            ValueError,
            r"the shape of its target, got \[8, 2, 1\] for \[8, 2, 6\]",
        ),
    ],
)
def test_networks_of_the_wrong_width_are_refused_and_never_broadcast(networks, make_clip, change, error, message):
    parts = dict(zip(FICRegLoss._networks, networks())) | change
    with pytest.raises(error, match=message):
        FICRegLoss(**parts, sigreg=SIGReg(4))(make_clip())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder": _Narrow(("pixels", "action"), ("latent",))}, "the encoder must read 1 entries, it reads"),
        ({"predictor": _Narrow(("latent",), ("predicted_latent",))}, "the predictor must read 2 entries, it reads"),
        ({"inverse_model": _Narrow(("latent",), ("a",))}, "the inverse_model must read 2 entries, it reads"),
    ],
)
def test_networks_whose_keys_do_not_fit_are_refused(networks, change, message):
    with pytest.raises(ValueError, match=message):
        FICRegLoss(**dict(zip(FICRegLoss._networks, networks())) | change)


def test_a_key_that_no_network_writes_is_named_at_the_first_call(networks, make_clip):
    encoder, predictor, _ = networks()
    loss = FICRegLoss(encoder, predictor, InverseDynamicsModel(6, 6, 8, kind="gaussian"), sigreg=SIGReg(4))
    loss.set_keys(recovered_action="guess")
    with pytest.raises(KeyError, match="no 'latent' among .*'code', 'skip'.*: see loss.set_keys"):
        LeWMLoss(_Narrow(("pixels",), ("code", "skip"), keep=3), predictor)(make_clip())
    with pytest.raises(KeyError, match="no 'guess' among .*'recovered_action'.*: see loss.set_keys"):
        loss(make_clip())


@pytest.mark.parametrize("frames", [2, 3])
def test_a_mask_shaped_like_torchrls_flags_is_the_same_mask(loss, make_clip, frames):
    """[B, T, 1] as [B, T], given in the clip, by keyword or by position."""
    clip, mask = make_clip(frames=frames), torch.rand(8, frames) > 0.3
    pixels, action = clip["pixels"], clip["action"]
    expected = values(loss.eval(), clip.clone().set("mask", mask))
    torch.testing.assert_close(values(loss, clip.set("mask", mask.unsqueeze(-1))), expected, rtol=0, atol=0)
    by_keyword = values(loss, pixels=pixels, action=action, mask=mask)
    by_position = values(loss, pixels, action, mask.unsqueeze(-1))
    for key, *found in zip(loss.out_keys, by_keyword, by_position, strict=True):
        assert all(value.equal(expected[key]) for value in found), key


def test_flat_slices_are_read_as_clips(make_loss, make_clip):
    """[B * T] with ``num_frames`` is [B, T], masked or not; a number of steps that is no multiple of T is refused."""
    clip = make_clip().set("mask", torch.rand(8, 3, 1) > 0.3)
    for name in ("lewm", "paper", "joint", "pldm"):
        loss = make_loss(name, num_frames=3).eval()
        expected = values(make_loss(name).eval(), clip)
        torch.testing.assert_close(values(loss, clip.reshape(24)), expected, rtol=0, atol=0)
        torch.testing.assert_close(values(loss, clip), expected, rtol=0, atol=0)
        torch.testing.assert_close(loss.peek(clip.reshape(24)), loss.peek(clip), rtol=0, atol=0)
        with pytest.raises(ValueError, match="holds 23 steps, which are no whole slices of num_frames=3"):
            loss(clip.reshape(24)[:23])
        with pytest.raises(ValueError, match="num_frames=3, the clips have 2 frames"):
            loss(clip[:, :2])
    with pytest.raises(ValueError, match="build the loss with num_frames=T"):
        make_loss("lewm")(clip.reshape(24))
    with pytest.raises(ValueError, match="num_frames must be a whole number of at least 2 frames, got 1"):
        make_loss("lewm", num_frames=1)


def test_a_slice_sampler_feeds_a_loss(make_loss, make_clip):
    """Samples of a TensorDictReplayBuffer with a SliceSampler, whole, as TorchRL hands them out."""
    episodes = make_clip(4, frames=9)
    episodes["episode"] = torch.arange(4)[:, None].expand(4, 9)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(36), sampler=SliceSampler(slice_len=3, traj_key="episode"), batch_size=24
    )
    buffer.extend(episodes.reshape(-1))
    loss = make_loss("paper", num_frames=3)
    sum(loss(buffer.sample()).values()).backward()
    assert all(param.grad is not None for param in loss.parameters())


def test_clips_that_go_on_after_an_end_are_refused(make_loss, make_clip):
    """Slices of another length than ``num_frames``, and batches of a collector, say so in ("next", "done")."""
    clip = make_clip(8, frames=3)
    clip["next", "done"] = torch.zeros(8, 3, 1, dtype=torch.bool)
    clip["next", "done"][:, -1] = True
    make_loss("lewm", num_frames=3)(clip.reshape(24))
    with pytest.raises(ValueError, match="4 transitions lead past .*'done'.* into another trajectory: give the loss"):
        make_loss("lewm", num_frames=6)(clip.reshape(24))
    clip["next", "done"][0, 0] = True
    with pytest.raises(ValueError, match="1 transitions lead past"):
        make_loss("lewm")(clip)
    clip["mask"] = ~clip["next", "done"]
    make_loss("lewm")(clip)
    with pytest.raises(KeyError, match="the clip has no 'action'"):
        make_loss("lewm")(clip.exclude("action"))


def test_transitions_are_clips_of_two_frames(loss, make_clip):
    """[B] and [B, 1] with ("next", "pixels"), masked too; a whole clip is read as before, whatever lies beside it."""
    clip = make_clip(frames=2)
    mask = torch.rand(8, 1) > 0.3
    expected = values(loss.eval(), clip.clone().set("mask", torch.cat([mask, mask], -1)))
    steps = clip[:, 0].clone()
    steps["next", "pixels"], steps["mask"] = clip["pixels"][:, 1], mask
    torch.testing.assert_close(values(loss, steps), expected, rtol=0, atol=0)
    steps = TensorDict(steps, [8])
    torch.testing.assert_close(values(loss, steps.unsqueeze(-1)), expected, rtol=0, atol=0)
    by_keyword = values(
        loss, pixels=steps["pixels"], action=steps["action"], mask=mask, next_pixels=steps["next", "pixels"]
    )
    for key, value in zip(loss.out_keys, by_keyword, strict=True):
        assert value.equal(expected[key])
    steps["next", "pixels"] = steps["next", "pixels"][..., :8]
    with pytest.raises(ValueError, match="must have the shape of 'pixels'"):
        loss(steps)
    whole = make_clip()
    expected = values(loss, whole)
    whole["next", "pixels"] = torch.zeros_like(whole["pixels"])
    torch.testing.assert_close(values(loss, whole), expected, rtol=0, atol=0)


@pytest.mark.parametrize("batch", [{}, {"mask": torch.ones(8, 3, dtype=torch.bool)}])
def test_a_plain_dict_is_told_to_become_a_tensordict(loss, make_clip, batch):
    with pytest.raises(TypeError, match=r"a loss takes a TensorDict, no plain dict or list: wrap it as TensorDict\(batch"):
        loss({**make_clip(), **batch})


def test_a_batch_of_one_transition_is_refused_in_terms_of_clips(make_loss, make_clip):
    for name in ("lewm", "paper", "joint"):
        with pytest.raises(ValueError, match="needs at least 2 clips, got 1: use a larger batch"):
            make_loss(name)(make_clip(1, frames=2))
    for name in ("joint_bare", "pldm"):
        with pytest.raises(ValueError, match="BatchNorm in train mode needs at least 2 clips"):
            make_loss(name)(make_clip(1, frames=2))
    assert len(make_loss("joint_bare").eval()(make_clip(1, frames=2)).keys()) == 2


def test_diagnostics_stand_beside_the_objective(make_loss, make_clip):
    """Its terms, all that begin with loss_, add up to one number with a gradient, with reports or without."""
    outputs = [values(make_loss("paper", diagnostics=on), make_clip()) for on in (False, True)]
    plain, reported = (sum(v for k, v in out.items() if k.startswith("loss_")) for out in outputs)
    assert reported.equal(plain)
    reported.backward()
    assert not any(v.requires_grad for k, v in outputs[1].items() if not k.startswith("loss_"))


def test_a_module_with_several_outputs_is_judged_after_set_keys(networks, make_clip, make_ficreg):
    """Constructors ask for nothing that set_keys can still say."""
    reference, clip = make_ficreg(0.0), make_clip()
    encoder, predictor, inverse_model = networks(0.0)

    def twice(module, in_keys, out_keys):
        return TensorDictSequential(module, TensorDictModule(lambda x: -x, in_keys, out_keys))

    loss = FICRegLoss(
        twice(encoder, ["latent"], ["skip"]),
        twice(CausalPredictor.select_out_keys(predictor, "predicted_latent"), ["predicted_latent"], [("x", "hat")]),
        twice(inverse_model, ["recovered_action"], ["flipped"]),
        sigreg=SIGReg(16),
    )
    torch.testing.assert_close(values(loss, clip), values(reference, clip))
    other = FICRegLoss(loss.encoder, loss.predictor, loss.inverse_model, sigreg=SIGReg(16))
    other.set_keys(latent="latent", predicted_latent=("x", "hat"), recovered_action="flipped")
    assert not values(other, clip)["loss_pred"].equal(values(reference, clip)["loss_pred"])


def test_a_loss_can_be_called_with_other_parameters(loss, make_clip):
    """By TensorDict.to_module, as the refusal of torch.func.functional_call says, which would leave them where they are."""
    clip, loss = make_clip(), loss.eval()
    params = {name: param.detach() * 1.1 for name, param in loss.named_parameters()}
    before = values(loss, clip)
    with pytest.raises(TypeError, match="write `with TensorDict.*to_module"):
        torch.func.functional_call(loss, params, (clip,))
    with TensorDict(params).unflatten_keys(".").to_module(loss):
        found = values(loss, clip)
    torch.testing.assert_close(values(loss, clip), before, rtol=0, atol=0)
    changed = copy.deepcopy(loss)
    with torch.no_grad():
        for name, param in changed.named_parameters():
            param.copy_(params[name])
    torch.testing.assert_close(found, values(changed, clip))


def test_a_loss_can_be_mapped_over_clips(loss, make_clip):
    """torch.vmap over a leading dimension of data, in eval mode, is the loop over it."""
    clips, loss = make_clip(2, 8), loss.eval()
    mapped = torch.vmap(lambda pixels, action: loss(pixels, action))(clips["pixels"], clips["action"])
    for key, *found in zip(loss.out_keys, mapped, strict=True):
        torch.testing.assert_close(found[0], torch.stack([values(loss, clip)[key] for clip in clips]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_networks_of_another_dtype_take_the_clips_as_they_are(loss, make_clip, dtype):
    """As under torch.set_default_dtype: data stay float32, the terms are at least that."""
    output = loss.to(dtype)(make_clip())
    assert all(value.dtype == (dtype if dtype == torch.float64 else torch.float32) for value in output.values())
    sum(output.values()).backward()


def test_networks_without_parameters_take_actions_of_any_dtype(make_clip):
    encoder = TensorDictModule(lambda pixels: pixels.flatten(-3)[..., :6] / 255, ["pixels"], ["latent"])
    predictor = TensorDictModule(lambda latent, action: latent + action, ["latent", "action"], ["predicted_latent"])
    clip = make_clip()
    clip["action"] = clip["action"].double()
    assert LeWMLoss(encoder, predictor)(clip)["loss_pred"].isfinite()


@pytest.mark.parametrize("floats", [True, False])
@pytest.mark.parametrize("name", ["lewm", "paper", "joint", "pldm"])
def test_a_loss_runs_on_fake_tensors(make_loss, make_clip, name, floats):
    """Which have a device, and no value that could be looked at."""
    loss, mode = make_loss(name), FakeTensorMode(allow_non_fake_inputs=True)
    clip = make_clip().set("mask", torch.ones(8, 3, dtype=torch.bool))
    clip["pixels"] = clip["pixels"] / 255 if floats else clip["pixels"]
    with mode:
        output = loss(clip.apply(mode.from_tensor))
        assert all(isinstance(value, FakeTensor) and value.shape == () for value in output.values())


def test_torch_func_differentiates_a_loss_by_its_parameters(make_loss, make_clip):
    """One gradient for every batch, by the way that the class names to call it with other parameters."""
    loss, clips = make_loss("paper").eval(), make_clip(2, 8)
    params = {name: param.detach() for name, param in loss.named_parameters()}

    def objective(params, clip):
        with TensorDict(params).unflatten_keys(".").to_module(loss):
            return sum(loss(clip).values())

    found = torch.vmap(torch.func.grad(objective), (None, 0))(params, clips)
    for place, clip in enumerate(clips):
        gradients = torch.autograd.grad(sum(loss(clip).values()), list(loss.parameters()))
        for name, gradient in zip(params, gradients, strict=True):
            torch.testing.assert_close(found[name][place], gradient, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["lewm", "paper", "joint", "pldm"])
def test_a_loss_runs_on_a_device_without_numbers(make_loss, make_clip, name):
    """On meta tensors, which know neither values nor autocast: terms of the right shape, with a gradient."""
    with torch.device("meta"):
        loss = make_loss(name)
    output = loss(make_clip().to("meta"))
    assert all(value.shape == () and value.device.type == "meta" for value in output.values())
    sum(output.values()).backward()


@pytest.mark.parametrize("place, name", enumerate(["encoder", "predictor", "inverse_model"]))
@pytest.mark.parametrize("other", [torch.nn.Linear(2, 2), None])
def test_networks_that_say_not_what_they_read_are_refused(networks, place, name, other):
    given = list(networks())
    given[place] = other
    with pytest.raises(TypeError, match=f"the {name} must be a TensorDictModule, got a .*: wrap a network as"):
        FICRegLoss(*given)


def test_unknown_choices_are_refused(networks):
    with pytest.raises(ValueError, match="unknown context 'dead': choose one of 'detached', 'live'"):
        FICRegLoss(*networks(), context="dead")
    for build in (lambda: LeWMLoss(*networks()[:2], reduction="max"), lambda: FICRegLoss(*networks(), reduction="max")):
        with pytest.raises(ValueError, match="unknown reduction 'max': choose 'mean', 'sum' or 'none'"):
            build()
