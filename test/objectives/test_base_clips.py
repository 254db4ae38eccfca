"""Claims about the clips that losses read: every layout gives the same numbers, and wrong clips are refused."""

from __future__ import annotations

import copy

import pytest
import torch
from _losses import call, COLLECTION, LATENT, LOSSES, make_clip, make_loss, make_mask, make_networks, total
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from torchrl_ficreg import FICRegLoss, LatentWorldModel, LeWMLoss, SIGReg
from torchrl_ficreg.modules.layers import check_finite

each_class = pytest.mark.parametrize("name", LOSSES)
ON_LATENTS = {"loss_sigreg", "loss_var", "loss_cov", "loss_time_sim", "loss_time_var", "loss_time_cov"}  # and on nothing else


def encode(loss, clip: TensorDict) -> TensorDict:
    """The clip with the latents of its frames in their place, if a loss is given."""
    clip = clip.clone()
    return clip if loss is None else clip.set("latent", loss.peek(clip).transpose(0, 1).contiguous()).exclude("pixels")


def check(loss, expected: TensorDict, *args, **kwargs) -> None:
    output = call(loss, *args, **kwargs)
    output = dict(zip(loss.out_keys, output, strict=True)) if isinstance(output, tuple) else output
    for key, value in expected.items():
        torch.testing.assert_close(output[key], value, rtol=0, atol=0, equal_nan=True, msg=key)


# Layouts


@pytest.mark.parametrize("held", ["pixels", "latent"])
@pytest.mark.parametrize("name", [*LOSSES, "two_steps"])
def test_all_layouts_of_a_clip_are_the_same_clip(name, held):
    """[B, T], and flat [B * T] with ``num_frames``; masks [B, T] and [B, T, 1]; by keyword, by position, by other keys."""
    loss, sliced = make_loss(name).eval(), make_loss(name, num_frames=3).eval()
    clip = encode(loss if held == "latent" else None, make_clip().set("mask", make_mask()))
    expected, flags = call(loss, clip), clip.clone().set("mask", clip["mask"].unsqueeze(-1))
    check(loss, expected, flags)
    check(loss, expected, **clip)
    check(loss, expected, **flags)
    if held == "pixels":
        check(loss, expected, *(flags[key] for key in ("pixels", "action", "mask")))
    check(sliced, expected, clip)
    check(sliced, expected, flags.reshape(24))
    assert sliced.peek(clip.reshape(24)).equal(loss.peek(clip))
    loss.set_keys(**{held: ("a", held), "action": "control", "mask": ("b", "c")})
    check(loss, expected, TensorDict({("a", held): clip[held], "control": clip["action"], ("b", "c"): clip["mask"]}))


@each_class
@pytest.mark.parametrize("held", ["pixels", "latent"])
def test_transitions_are_clips_of_two_frames(name, held):
    """[B] and [B, 1] with ("next", "pixels") or ("next", "latent"), masked [B, 1], and by keyword."""
    loss, mask = make_loss(name).eval(), make_mask(frames=1)
    clip = encode(loss if held == "latent" else None, make_clip(frames=2).set("mask", mask.expand(8, 2)))
    expected, steps = call(loss, clip), TensorDict({"mask": mask, "action": clip["action"][:, 0]}, [8])
    steps[held], steps["next", held] = clip[held].unbind(1)
    check(loss, expected, steps)
    check(loss, expected, steps.unsqueeze(-1))
    by_keyword = {held: steps[held], f"next_{held}": steps["next", held]}
    check(loss, expected, action=steps["action"], mask=mask, **by_keyword)
    steps["next", held] = steps["next", held][..., :4]
    with pytest.raises(ValueError, match=f"must have the shape of '{held}'"):
        loss(steps)


@each_class
def test_a_mask_of_ones_and_a_next_entry_beside_whole_clips_change_nothing(name):
    """A collector writes ("next", "pixels") there too: it is not read."""
    clip = make_clip()
    expected = call(make_loss(name), clip)
    clip["next", "pixels"] = torch.zeros_like(clip["pixels"])
    torch.testing.assert_close(call(make_loss(name), clip.set("mask", torch.ones(8, 3) > 0)), expected)


@pytest.mark.parametrize("name", COLLECTION)
def test_latents_take_the_place_of_pixels(name):
    """Terms are those of the encoded frames, but terms on latents alone are zero, as no parameter could change them.

    The encoder is not called, neither it nor the latents receive gradient, and no direction is drawn. With ``pixels`` beside
    them, latents are not read.
    """
    loss, clip, calls = make_loss(name).eval(), make_clip().set("mask", make_mask()), []
    expected, encoded = call(loss, clip), encode(loss, clip)
    check(loss, expected, clip.clone().set("latent", torch.zeros(8, 3, LATENT)))
    latent = encoded["latent"].requires_grad_()
    encoded["latent"] = latent
    loss.encoder.register_forward_pre_hook(lambda *_: calls.append(1))
    for key, value in call(loss, encoded).items():
        torch.testing.assert_close(value, torch.zeros(()) if key in ON_LATENTS else expected[key], msg=key)
    assert loss.peek(encoded).equal(latent.transpose(0, 1))
    before = copy.deepcopy(loss.encoder.state_dict())
    total(call(loss.train(), encoded)).backward()
    assert latent.grad is None and not calls
    for network in loss._networks:
        assert all((param.grad is None) == (network == "encoder") for param in getattr(loss, network).parameters()), network
    assert all(value.equal(before[key]) for key, value in loss.encoder.state_dict().items())
    assert not hasattr(loss, "sigreg") or loss.sigreg.generator_state[1] == 0


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_given_latents_reduce_as_pixels_do(reduction):
    """The temporal similarity, which is a term of transitions, has their shape although it is zero."""
    loss = make_loss("pldm", reduction=reduction)
    expected, found = loss(make_clip()), loss(make_clip().exclude("pixels").set("latent", torch.randn(8, 3, LATENT)))
    assert {key: value.shape for key, value in found.items()} == {key: value.shape for key, value in expected.items()}


def test_a_slice_sampler_feeds_a_loss():
    """Samples of a TensorDictReplayBuffer with a SliceSampler, whole, as TorchRL hands them out."""
    episodes = make_clip(4, frames=9)
    episodes["episode"] = torch.arange(4)[:, None].expand(4, 9)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(36), sampler=SliceSampler(slice_len=3, traj_key="episode"), batch_size=24
    )
    buffer.extend(episodes.reshape(-1))
    loss = make_loss("paper", num_frames=3)
    total(loss(buffer.sample())).backward()
    assert all(param.grad is not None for param in loss.parameters())


def test_slices_of_another_length_are_refused():
    clip = make_clip()
    for name in LOSSES:
        loss = make_loss(name, num_frames=3)
        with pytest.raises(ValueError, match="holds 23 steps, not a multiple of num_frames=3"):
            loss(clip.reshape(24)[:23])
        with pytest.raises(ValueError, match="num_frames=3, the clips have 2 frames"):
            loss(clip[:, :2])
    with pytest.raises(ValueError, match="build the loss with num_frames=T"):
        make_loss("lewm")(clip.reshape(24))


def test_clips_that_go_on_after_an_end_are_refused():
    """Slices of another length than ``num_frames``, and batches of a collector, mark it in ("next", "done")."""
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


# Masks


@pytest.mark.parametrize("name", ["paper", "live", "pldm"])
@pytest.mark.parametrize("poison", [torch.nan, torch.inf, 1e30])
def test_masked_transitions_contribute_nothing_whatever_their_action(name, poison):
    """The last block of half the clips is masked: the terms are those of the blocks that are left."""
    clip, mask = make_clip(), torch.ones(8, 3, dtype=torch.bool)
    mask[4:, 1] = False
    expected = call(make_loss(name, reduction="none").eval(), clip)
    clip["mask"] = mask
    clip["action"][4:, 1] = poison
    clip["action"][:, 2] = poison  # leads out of the clip: never read, masked or not
    loss = make_loss(name).eval()
    output = call(loss, clip)
    for term in ("loss_pred", "loss_idm", *(["loss_time_sim"] if name == "pldm" else ["loss_consistency"])):
        torch.testing.assert_close(output[term], expected[term][mask[:, :-1]].mean())
    total(output).backward()
    assert all(param.grad.isfinite().all() for param in loss.parameters())


# Wrong clips


def _poison(clip, value):
    clip["action"][3, 1, 0] = value
    return clip


def _latents(clip, value):
    return clip.exclude("pixels").set("latent", value)


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
        (lambda c: c.set("mask", torch.ones(8, 3, 2) > 0), ValueError, r"expected \[8, 3\] bool, got \[8, 3, 2\]"),
        (lambda c: TensorDict({**c, "mask": torch.ones(8, 1, dtype=torch.bool)}, [8]), ValueError, r"got \[8, 1\]"),
        (lambda c: c.set("mask", torch.ones(8, 3)), ValueError, "got .* torch.float32"),
        (lambda c: c.set("mask", torch.zeros(8, 3) > 0), ValueError, "the mask leaves no transition"),
        (lambda c: c.set("mask", torch.arange(3).expand(8, 3) > 1), ValueError, "the mask leaves no transition"),
        (lambda c: _poison(c, torch.nan), ValueError, "1 of 16 action blocks hold a NaN or an infinity"),
        (lambda c: _poison(c, torch.inf), ValueError, "1 of 16 action blocks hold a NaN or an infinity"),
        (lambda c: c[:0], ValueError, "the batch of clips is empty"),
        (lambda c: {**c}, TypeError, r"a loss takes a TensorDict, no plain dict or list: wrap it as TensorDict\(batch"),
        (lambda c: {**c, "mask": c["action"] > 0}, TypeError, "a loss takes a TensorDict, no plain dict or list"),
        (lambda c: _latents(c, torch.full((8, 3, 6), torch.nan)), ValueError, r"'latent' \[8, 3, 6\] holds a NaN"),
        (lambda c: _latents(c, torch.ones(8, 3, 6).long()), TypeError, "'latent' of a clip must be floating, got .*int64"),
        (lambda c: _latents(c, torch.ones(8, 3)), ValueError, r"latents \[B, T, D\] with T >= 2, got \[8, 3\]"),
    ],
)
def test_a_wrong_clip_is_refused_and_a_right_one_taken_afterwards(change, error, message):
    loss = make_loss("paper")
    with pytest.raises(error, match=message):
        loss(change(make_clip()))
    total(loss(make_clip())).backward()
    assert all(param.grad is not None for param in loss.parameters())


def test_a_batch_of_one_clip_is_refused():
    """With SIGReg or variances over the batch, and by BatchNorm where it leaves one transition."""
    for names, frames, message in (
        (LOSSES, 3, "at least 2 clips"),
        (("lewm", "paper", "joint"), 2, "needs at least 2 clips, got 1: use a larger batch"),
        (("joint_bare", "pldm"), 2, "BatchNorm in train mode needs at least 2 clips"),
    ):
        for name in names:
            with pytest.raises(ValueError, match=message):
                make_loss(name)(make_clip(1, frames=frames))
    assert len(make_loss("joint_bare").eval()(make_clip(1, frames=2)).keys()) == 2


# Values and dtypes


class _OwnEncoder(nn.Module):
    """One that checks no value: BatchNorm on the flat frames."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(768), nn.Linear(768, 6))

    def forward(self, pixels):
        return self.net(pixels.flatten(0, -4).float()).unflatten(0, pixels.shape[:-3])


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_pixels_that_are_not_finite_are_refused_before_any_statistic_moves(value):
    """By a loss and a world model around any encoder; in a graph that is traced nothing is checked."""
    _, predictor, inverse_model = make_networks()
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
    total(loss(clip)).backward()
    assert all(param.grad.isfinite().all() for param in loss.parameters())
    graph = torch.compile(lambda pixels: check_finite(pixels) or pixels + 1, fullgraph=True, backend="eager")
    assert not graph(poisoned["pixels"]).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_actions_of_another_precision_are_taken_in_that_of_the_networks(dtype):
    """NumPy's default is float64; a float64 network takes float64 actions as they are."""
    loss, clip = make_loss("paper").eval(), make_clip()
    clip["action"] = clip["action"].bfloat16().float()  # exact in all of them
    expected = call(loss, clip)
    torch.testing.assert_close(call(loss, clip.clone().set("action", clip["action"].to(dtype))), expected)
    assert call(loss.double(), clip.set("action", clip["action"].double()))["loss_pred"].dtype == torch.float64


@each_class
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_networks_of_another_dtype_take_the_clips_as_they_are(name, dtype):
    """As under torch.set_default_dtype: data stay float32, latents too, the terms are at least that."""
    loss = make_loss(name).to(dtype)
    for clip in (make_clip(), _latents(make_clip(), torch.randn(8, 3, LATENT))):
        output = loss(clip)
        assert all(value.dtype == (dtype if dtype == torch.float64 else torch.float32) for value in output.values())
        total(output).backward()


def test_networks_without_parameters_take_actions_of_any_dtype():
    encoder = TensorDictModule(lambda pixels: pixels.flatten(-3)[..., :6] / 255, ["pixels"], ["latent"])
    predictor = TensorDictModule(lambda latent, action: latent + action, ["latent", "action"], ["predicted_latent"])
    clip = make_clip()
    clip["action"] = clip["action"].double()
    assert LeWMLoss(encoder, predictor)(clip)["loss_pred"].isfinite()
