"""What every loss of the collection owes TorchRL and its users, as tests to inherit. Warnings are errors.

The demands are those of TorchRL's own base of loss tests: an unknown key raises, defaults are as documented, every key
can be set, also all to one name; resetting reaches every parameter; a loss can be copied; its input stays as it is.
"""

from __future__ import annotations

import copy
import dataclasses

import pytest
import torch
from loss_collection import COLLECTION, make_clip, make_loss, make_mask
from tensordict import TensorDict
from torchrl.objectives.common import LossModule

DEFAULT_KEYS = {
    name: name for name in ("pixels", "action", "mask", "latent", "predicted_latent", "recovered_action")
}
PER_TRANSITION = {"loss_pred", "loss_idm", "loss_consistency", "loss_time_sim"}  # the other terms are one number


def call(loss: LossModule, *args, **kwargs):
    """One call under one seed, with the directions SIGReg draws first."""
    torch.manual_seed(0)
    if hasattr(loss, "sigreg"):
        loss.sigreg.generator_state[1] = 0
    return loss(*args, **kwargs)


def total(output: TensorDict) -> torch.Tensor:
    """The objective: the plain sum of all terms."""
    return sum(value.sum() for key, value in output.items() if key.startswith("loss"))


class LossTestBase:
    """Tests of the loss ``name`` of the collection."""

    name: str
    pytestmark = pytest.mark.filterwarnings("error")

    @pytest.fixture
    def loss(self) -> LossModule:
        return make_loss(self.name)

    @property
    def coefficients(self) -> list[str]:
        return sorted(name for name, _ in make_loss(self.name).named_buffers() if name.endswith("_coeff"))

    # keys

    def test_default_keys(self, loss):
        """The names of the key contract, and a dataclass that says so."""
        assert dataclasses.asdict(loss.default_keys()) == DEFAULT_KEYS
        assert dataclasses.asdict(loss.tensor_keys) == DEFAULT_KEYS
        assert loss.in_keys == ["pixels", "action"]

    def test_an_unknown_key_is_refused(self, loss):
        with pytest.raises(ValueError, match="frames is not an accepted tensordict key"):
            loss.set_keys(frames="pixels")
        assert dataclasses.asdict(loss.tensor_keys) == DEFAULT_KEYS

    @pytest.mark.parametrize("name", ["test", ("nested", "deep", "test")])
    def test_every_key_can_be_set(self, loss, name):
        """One by one, then all to the same name; in_keys follow, another loss does not."""
        for key in DEFAULT_KEYS:
            loss.set_keys(**{key: name})
            assert getattr(loss.tensor_keys, key) == name
        one = make_loss(self.name)
        one.set_keys(**dict.fromkeys(DEFAULT_KEYS, name))
        assert set(dataclasses.asdict(one.tensor_keys).values()) == {name}
        assert loss.in_keys == one.in_keys == [name, name]
        assert make_loss(self.name).in_keys == ["pixels", "action"]

    def test_renamed_entries_give_the_same_numbers(self, loss):
        clip = make_clip().set("mask", make_mask())
        expected = call(loss.eval(), clip)
        renamed = TensorDict({("obs", "rgb"): clip["pixels"], "control": clip["action"], ("a", "b", "c"): clip["mask"]})
        loss.set_keys(pixels=("obs", "rgb"), action="control", mask=("a", "b", "c"))
        torch.testing.assert_close(call(loss, renamed), expected, rtol=0, atol=0)

    # calls

    def test_the_clip_is_left_alone(self, loss):
        clip = make_clip().set("mask", make_mask())
        before = clip.clone()
        output = call(loss, clip)
        total(output).backward()
        assert set(clip.keys(True)) == {"pixels", "action", "mask"}
        assert (clip == before).all()
        assert output is not clip

    def test_out_keys_are_what_it_writes(self, loss):
        output = call(loss, make_clip())
        assert list(output.keys()) == loss.out_keys
        assert {key for key in output.keys() if key.startswith("loss")} == set(COLLECTION[self.name][3])
        for key, value in output.items():
            assert value.dtype == torch.float32, key
            assert value.isfinite().all(), key
            assert value.requires_grad == key.startswith("loss"), key

    def test_it_can_be_called_by_keyword(self, loss):
        expected = call(loss, make_clip())
        values = call(make_loss(self.name), **make_clip())
        for key, value in zip(loss.out_keys, values, strict=True):
            assert value.equal(expected[key]), key

    def test_another_batch_shape_is_the_same_batch(self, loss):
        flat, nested = call(loss, make_clip(8)), call(make_loss(self.name), make_clip(2, 4))
        torch.testing.assert_close(nested, flat)

    @pytest.mark.parametrize("masked", [False, True])
    def test_reductions(self, masked):
        """``mean`` and ``sum`` are those of the selected transitions; a statistic is one number whatever is asked."""
        clip, kept = make_clip(), torch.ones(8, 3, dtype=torch.bool)
        if masked:
            kept = make_mask()
            clip["mask"] = kept
        kept = kept[:, :-1]
        none, mean, summed = (
            call(make_loss(self.name, reduction=reduction), clip) for reduction in ("none", "mean", "sum")
        )
        for term in COLLECTION[self.name][3]:
            if term in PER_TRANSITION:
                assert none[term].shape == (8, 2)
                assert (none[term][~kept] == 0).all()
                torch.testing.assert_close(mean[term], none[term][kept].mean())
                torch.testing.assert_close(summed[term], none[term].sum())
            else:
                assert none[term].shape == ()
                assert none[term].equal(mean[term])
                assert none[term].equal(summed[term])

    # state

    def test_reset_parameters_recursive(self, loss):
        """Every parameter of every network is drawn anew, and the networks themselves are what was reset."""
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

    def test_a_deep_copy_stands_alone(self, loss):
        expected = call(loss.eval(), make_clip())
        duplicate = copy.deepcopy(loss)
        torch.testing.assert_close(call(duplicate, make_clip()), expected, rtol=0, atol=0)
        with torch.no_grad():
            for param in duplicate.parameters():
                param.mul_(3)
        assert not total(call(duplicate, make_clip())).equal(total(expected))
        torch.testing.assert_close(call(loss, make_clip()), expected, rtol=0, atol=0)

    def test_a_state_dict_carries_everything(self, loss):
        """Weights, statistics, coefficients and the directions to come."""
        for coefficient in self.coefficients:
            setattr(loss, coefficient, 0.7)
        optimizer = torch.optim.SGD(loss.parameters(), 0.1)
        total(loss(make_clip())).backward()
        optimizer.step()
        fresh = make_loss(self.name)
        fresh.load_state_dict(loss.state_dict())
        outputs = []
        for each in (loss, fresh):
            torch.manual_seed(0)
            outputs.append(each(make_clip()))
        torch.testing.assert_close(outputs[1], outputs[0], rtol=0, atol=0)

    def test_parameters_are_the_networks_own_and_come_once(self, loss):
        params = list(loss.parameters())
        assert len(params) == len(set(params))
        assert set(params) == {p for name in loss._networks for p in getattr(loss, name).parameters()}

    def test_train_and_eval_reach_the_networks(self, loss):
        networks = [getattr(loss, name) for name in loss._networks]
        for mode in (False, True):
            assert loss.train(mode) is loss
            assert all(module.training == mode for network in networks for module in network.modules())
        loss.eval()
        before = copy.deepcopy(loss.state_dict())
        loss(make_clip())
        assert all(value.equal(before[key]) for key, value in loss.state_dict().items())

    # arguments

    @pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
    def test_coefficients_out_of_range_are_refused(self, value):
        for coefficient in self.coefficients:
            with pytest.raises(ValueError, match=f"{coefficient} must be finite and not negative"):
                make_loss(self.name, **{coefficient: value})

    def test_an_unknown_reduction_is_refused(self):
        with pytest.raises(ValueError, match="unknown reduction 'max': choose 'mean', 'sum' or 'none'"):
            make_loss(self.name, reduction="max")

    def test_coefficients_scale_their_own_term(self, loss):
        """Assigned in place, so that schedules and compiled losses follow."""
        before = call(loss.eval(), make_clip())
        for coefficient in self.coefficients:
            term, buffer = f"loss_{coefficient.removesuffix('_coeff')}", getattr(loss, coefficient)
            if term not in loss.out_keys:
                continue
            setattr(loss, coefficient, 3 * buffer.item())
            assert getattr(loss, coefficient) is buffer
            after = call(loss, make_clip())
            torch.testing.assert_close(after[term], 3 * before[term])
            setattr(loss, coefficient, buffer.item() / 3)
            assert all(after[key].equal(before[key]) for key in before.keys() if key != term)
