"""Claim: every loss is a TorchRL loss module as one should be: keys, state, modes, copies, arguments.

The demands are those of TorchRL's own base of loss tests: an unknown key raises, defaults are as documented, every key
can be set, also all to one name; resetting reaches every parameter; a loss can be copied; its input is not modified.
"""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from _losses import call, coefficients, COLLECTION, LOSSES, make_clip, make_loss, make_mask, total

pytestmark = pytest.mark.filterwarnings("error")

DEFAULT_KEYS = {
    name: name
    for name in (
        *("pixels", "action", "mask", "latent", "predicted_latent", "recovered_action"),
        *("recovered_action_log_var", "recovered_action_variance"),
    )
}
PER_TRANSITION = {"loss_pred", "loss_idm", "loss_consistency", "loss_time_sim"}  # the other terms are one number

each_class = pytest.mark.parametrize("name", LOSSES)
each_variant = pytest.mark.parametrize("name", COLLECTION)


# Keys


@each_class
def test_default_keys(name):
    loss = make_loss(name)
    assert dataclasses.asdict(loss.default_keys()) == dataclasses.asdict(loss.tensor_keys) == DEFAULT_KEYS
    assert loss.in_keys == ["pixels", "action"]
    with pytest.raises(ValueError, match="frames is not an accepted tensordict key"):
        loss.set_keys(frames="pixels")
    assert dataclasses.asdict(loss.tensor_keys) == DEFAULT_KEYS


@each_class
@pytest.mark.parametrize("key", ["test", ("nested", "deep", "test")])
def test_every_key_can_be_set(name, key):
    """One by one, then all to the same name; in_keys follow, those of another loss do not."""
    loss, other = make_loss(name), make_loss(name)
    for field in DEFAULT_KEYS:
        loss.set_keys(**{field: key})
        assert getattr(loss.tensor_keys, field) == key
    other.set_keys(**dict.fromkeys(DEFAULT_KEYS, key))
    assert set(dataclasses.asdict(other.tensor_keys).values()) == {key}
    assert loss.in_keys == other.in_keys == [key, key]
    assert make_loss(name).in_keys == ["pixels", "action"]


@pytest.mark.parametrize(("name", "field"), [("nll", "recovered_action_log_var"), ("ensemble", "recovered_action_variance")])
def test_certainty_of_an_inverse_model_can_be_renamed(name, field):
    """Without its name the log-variance is missing; the variance is optional, and changes the training error."""
    expected, loss = call(make_loss(name).eval(), make_clip()), make_loss(name).eval()
    loss.inverse_model.out_keys[1] = ("certainty", "of it")
    if name == "nll":
        with pytest.raises(ValueError, match="consistency='nll' needs an inverse model that writes"):
            call(loss, make_clip())
    else:
        assert call(loss, make_clip())["loss_idm"] < expected["loss_idm"]
    loss.set_keys(**{field: ("certainty", "of it")})
    torch.testing.assert_close(call(loss, make_clip()), expected, rtol=0, atol=0)


# Calls


@each_class
def test_the_clip_is_not_modified(name):
    clip = make_clip().set("mask", make_mask())
    before = clip.clone()
    output = call(make_loss(name), clip)
    total(output).backward()
    assert set(clip.keys(True)) == {"pixels", "action", "mask"}
    assert (clip == before).all()
    assert output is not clip


@each_variant
def test_out_keys_are_what_it_writes(name):
    loss = make_loss(name)
    output = call(loss, make_clip())
    assert list(output.keys()) == loss.out_keys
    assert output.batch_size == torch.Size([])
    assert {key for key in output.keys() if key.startswith("loss")} == set(COLLECTION[name][3])
    for key, value in output.items():
        assert value.dtype == torch.float32, key
        assert value.isfinite().all(), key
        assert value.requires_grad == key.startswith("loss"), key


@each_variant
def test_another_batch_shape_is_the_same_batch(name):
    """A clip [2, 4, T] is the clip [8, T]: values, gradients, and the shape of unreduced terms."""
    assert make_clip(2, 4)["pixels"].flatten(0, 1).equal(make_clip(8)["pixels"])
    flat, nested = make_loss(name), make_loss(name)
    outputs = call(flat, make_clip(8)), call(nested, make_clip(2, 4))
    torch.testing.assert_close(outputs[1], outputs[0])
    for output in outputs:
        total(output).backward()
    for ours, theirs in zip(nested.parameters(), flat.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad)
    for term, value in call(make_loss(name, reduction="none"), make_clip(2, 4)).items():
        assert not term.startswith("loss") or value.shape == ((2, 4, 2) if term in PER_TRANSITION else ())


@pytest.mark.parametrize(("name", "masked"), [*((name, True) for name in COLLECTION), *((name, False) for name in LOSSES)])
def test_reductions(name, masked):
    """``mean`` and ``sum`` are those of the unmasked transitions; a statistic is one number under any reduction."""
    kept = make_mask() if masked else torch.ones(8, 3, dtype=torch.bool)
    clip = make_clip().set("mask", kept) if masked else make_clip()
    kept = kept[:, :-1]
    none, mean, summed = (call(make_loss(name, reduction=reduction), clip) for reduction in ("none", "mean", "sum"))
    for term in COLLECTION[name][3]:
        if term in PER_TRANSITION:
            assert (none[term][~kept] == 0).all()
            torch.testing.assert_close(mean[term], none[term][kept].mean())
            torch.testing.assert_close(summed[term], none[term].sum())
        else:
            assert none[term].equal(mean[term])
            assert none[term].equal(summed[term])


# State


@pytest.mark.parametrize("name", [*LOSSES, "nll", "ensemble", "transformer"])
def test_reset_parameters_recursive(name):
    """Every parameter of every network is drawn anew, and the networks themselves are reset."""
    loss = make_loss(name)
    with torch.no_grad():
        for param in loss.parameters():
            param += 1000
    before = {name: param.clone() for name, param in loss.named_parameters()}
    loss.reset_parameters_recursive()
    assert [name for name, param in loss.named_parameters() if (param == before[name]).any()] == []
    for network in loss._networks:
        ours = set(getattr(loss, f"{network}_params").parameters())
        assert ours == set(getattr(loss, network).parameters())
    assert total(call(loss, make_clip())).isfinite()


@each_class
def test_a_deep_copy_is_independent(name):
    loss = make_loss(name).eval()
    expected, duplicate = call(loss, make_clip()), copy.deepcopy(loss)
    torch.testing.assert_close(call(duplicate, make_clip()), expected, rtol=0, atol=0)
    with torch.no_grad():
        for param in duplicate.parameters():
            param.mul_(3)
    changed = call(duplicate, make_clip())
    assert not any(changed[key].equal(expected[key]) for key in COLLECTION[name][3])
    torch.testing.assert_close(call(loss, make_clip()), expected, rtol=0, atol=0)


@each_class
def test_a_state_dict_holds_everything(name):
    """Weights, statistics, coefficients and the directions to come; the networks of the other loss hold them too."""
    loss, fresh = make_loss(name), make_loss(name)
    for coefficient in coefficients(loss):
        setattr(loss, coefficient, 0.7)
    total(loss(make_clip())).backward()
    torch.optim.SGD(loss.parameters(), 0.1).step()
    fresh.load_state_dict(loss.state_dict())
    outputs = []
    for each in (loss, fresh):
        torch.manual_seed(0)
        outputs.append(each(make_clip()))
    torch.testing.assert_close(outputs[1], outputs[0], rtol=0, atol=0)
    for network in loss._networks:
        ours, theirs = getattr(fresh, network).state_dict(), getattr(loss, network).state_dict()
        assert all(ours[key].equal(theirs[key]) for key in theirs)


@each_class
def test_parameters_are_those_of_the_networks_each_once(name):
    loss = make_loss(name)
    params = list(loss.parameters())
    expected = [param for network in loss._networks for param in getattr(loss, network).parameters()]
    assert len(params) == len(set(params)) == len(expected)
    assert set(params) == set(expected)


@each_class
def test_train_and_eval_reach_the_networks(name):
    """In eval mode no statistic moves, and a second call gives the same numbers."""
    loss = make_loss(name)
    modules = [module for network in loss._networks for module in getattr(loss, network).modules()]
    assert all(module.training for module in modules)
    for mode in (True, False):
        assert loss.train(mode) is loss
        assert all(module.training == mode for module in modules)
    before = copy.deepcopy(loss.state_dict())
    torch.testing.assert_close(loss(make_clip()), loss(make_clip()), rtol=0, atol=0)
    assert all(value.equal(before[key]) for key, value in loss.state_dict().items())


# Arguments


@each_class
def test_coefficients_scale_their_own_term(name):
    """Assigned in place, so that schedules and compiled losses follow, and saved; out of range they are refused."""
    loss = make_loss(name).eval()
    before = call(loss, make_clip())
    for coefficient in coefficients(loss):
        for value in (-0.1, float("nan"), float("inf")):
            with pytest.raises(ValueError, match=f"{coefficient} must be finite and not negative"):
                make_loss(name, **{coefficient: value})
        term, buffer = f"loss_{coefficient.removesuffix('_coeff')}", getattr(loss, coefficient)
        setattr(loss, coefficient, 3 * buffer.item())
        assert getattr(loss, coefficient) is buffer
        assert loss.state_dict()[coefficient].equal(buffer)
        after = call(loss, make_clip())
        torch.testing.assert_close(after[term], 3 * before[term])
        setattr(loss, coefficient, buffer.item() / 3)
        assert all(after[key].equal(before[key]) for key in before.keys() if key != term)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        *((name, {"reduction": "max"}, "unknown reduction 'max': choose 'mean', 'sum' or 'none'") for name in LOSSES),
        *((name, {"num_frames": 1}, "num_frames must be a whole number of at least 2 frames, got 1") for name in LOSSES),
        ("paper", {"context": "dead"}, "unknown context 'dead': choose one of 'detached', 'live'"),
        ("paper", {"consistency": "mae"}, "unknown consistency 'mae': choose one of 'mse', 'nll', 'trusted'"),
        ("paper", {"consistency_target": "goal"}, "unknown consistency_target 'goal': choose one of 'action', 'judge'"),
        ("paper", {"consistency_steps": 0}, "consistency_steps must be a positive whole number, got 0"),
        ("paper", {"consistency_steps": 1.5}, "consistency_steps must be a positive whole number, got 1.5"),
        ("paper", {"consistency": "nll"}, "consistency='nll' needs an inverse model that writes 'recovered_action_log_v"),
        *(("pldm", {"std_margin": margin}, "std_margin must be positive") for margin in (0.0, -1.0, float("nan"))),
    ],
)
def test_wrong_arguments_are_refused(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        make_loss(name, **arguments)
