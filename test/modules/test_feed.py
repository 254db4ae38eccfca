"""Claim: networks are fed by the names of their keys, in any order; by position only where no name is known."""

from __future__ import annotations

import itertools
from functools import partial

import pytest
import torch
from _losses import make_clip, make_networks
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import (
    CausalPredictor,
    CEMConfig,
    FICRegLoss,
    GoalPolicy,
    InverseConsistency,
    InverseDynamicsModel,
    LatentCEMPlanner,
    LatentWorldModel,
    SIGReg,
)
from torchrl_ficreg.modules.feed import arrange

PREDICTOR, INVERSE = {"latent": (), "action": ()}, {"latent": (), "next_latent": ()}
OUT = {"predictor": "predicted_latent", "inverse_model": "recovered_action"}


class Exchanged(nn.Module):
    """A network that takes its two inputs in the other order; planning asks for its sizes."""

    def __init__(self, network):
        super().__init__()
        self.network, self.history = network, getattr(network, "history", None)
        self.latent_dim, self.action_dim = (getattr(network, name, None) for name in ("latent_dim", "action_dim"))

    def forward(self, second, first):
        return self.network(first, second)


def rewrap(module, in_keys, out_key, exchange):
    """The network of a module behind other keys, those exchanged where asked for, and its inputs with them."""
    network, keys = (Exchanged(module.module), in_keys[::-1]) if exchange else (module.module, in_keys)
    wrapped = TensorDictModule(network, list(keys), [out_key])
    if module.module.__class__.__name__ == "CausalTransformer":
        wrapped.history = module.history
    return wrapped


@pytest.mark.parametrize("exchange", [False, True])
@pytest.mark.parametrize(
    ("latent_key", "predictor_keys", "inverse_keys", "renamed"),
    [
        ("latent", ("latent", "action"), ("latent", ("next", "latent")), {}),
        ("latent", ("latent", "action"), ("latent", "next_latent"), {}),
        ("latent", ("latent", "scaled"), ("before", "next_latent"), {}),
        ("latent", ("scaled", "action"), ("before", "latent_next"), {}),
        ("latent", ("latent", "action"), ("latent", "predicted_latent"), {}),
        ("code", ("code", "action"), ("code", ("next", "code")), {}),
        (("belief", "mean"), (("belief", "mean"), ("agent", "action")), (("belief", "mean"), ("next", "mean")), {}),
        ("latent", (("obs", "latent"), ("agent", "action")), (("obs", "latent"), ("next", "obs", "latent")), {}),
        ("latent", ("z", "u"), ("z", "next_z"), {"latent": "z", "action": "u"}),
        ("latent", (("a", "z"), ("a", "u")), ("z", ("next", "z")), {"latent": ("b", "z"), "action": ("a", "u")}),
    ],
)
def test_exchanged_keys_give_the_same_numbers(latent_key, predictor_keys, inverse_keys, renamed, exchange):
    """Whatever networks call their outputs. Latents and action blocks are equally wide: an exchange would raise no error."""
    encoder, predictor, inverse_model = make_networks(0.0)
    clip = make_clip()
    reference = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(16)).eval()
    other = FICRegLoss(
        TensorDictModule(encoder.module, [("obs", "rgb")], [latent_key]),
        rewrap(predictor, predictor_keys, ("next", "belief"), exchange),
        rewrap(inverse_model, inverse_keys, ("agent", "recovered"), exchange),
        sigreg=SIGReg(16),
    ).eval()
    if renamed:
        other.set_keys(**renamed)
        clip = clip.rename_key_("action", renamed["action"])
        reference.set_keys(action=renamed["action"])
    losses = [loss(clip) for loss in (reference, other)]
    torch.testing.assert_close(losses[1], losses[0], rtol=0, atol=0)


def test_a_sequence_and_keyword_arguments_name_inputs_too():
    """TensorDictSequential lists its in_keys in another order, here the action first; keywords name the inputs of a network."""
    encoder, predictor, inverse_model = make_networks(0.0)
    sequence = TensorDictSequential(
        TensorDictModule(lambda action: 1.0 * action, ["action"], ["scaled"]),
        TensorDictModule(predictor.module, ["latent", "scaled"], ["predicted_latent"]),
        selected_out_keys=["predicted_latent"],
    )
    assert sequence.in_keys == ["action", "latent"]
    by_keyword = TensorDictModule(predictor.module, in_keys={"action": "u", "latent": "z"}, out_keys=["hat"])
    expected, *losses = (
        FICRegLoss(encoder, each, inverse_model, sigreg=SIGReg(16)).eval()(make_clip())
        for each in (predictor, sequence, by_keyword)
    )
    for loss in losses:
        torch.testing.assert_close(loss, expected, rtol=0, atol=0)


@pytest.mark.parametrize("latent_key", ["latent", ("belief", "mean")])
def test_planners_and_costs_feed_by_name_too(latent_key):
    """Prediction, rollout, plan and judgement of exchanged modules are those of the originals."""
    encoder, predictor, inverse_model = (module.eval() for module in make_networks(0.0))
    encoder = TensorDictModule(encoder.module, ["pixels"], [latent_key])
    after = ("next", *latent_key) if isinstance(latent_key, tuple) else ("next", latent_key)
    plans, latent, goal = [], torch.randn(2, 6), torch.randn(2, 6)
    for exchange in (False, True):
        judge = rewrap(inverse_model, (latent_key, after), "recovered_action", exchange)
        model = LatentWorldModel(
            encoder, rewrap(predictor, (latent_key, "action"), "predicted_latent", exchange), frame_skip=2
        )
        torch.manual_seed(0)
        path, block = torch.randn(2, 3, 2, 6), torch.randn(2, 3, 2, 6)
        cost = InverseConsistency(judge)(path, goal, block, latent)
        planner = LatentCEMPlanner(model.eval(), CEMConfig(num_candidates=8, num_elites=2, iterations=2, bounds="none", precision="fp32"))
        plans.append((model.predict(path, block), model.rollout(path, block), cost, planner.plan(latent, goal)["plan"]))
    for one, other in zip(*plans, strict=True):
        torch.testing.assert_close(other, one)


@pytest.mark.parametrize("exchange", [False, True])
def test_the_packages_own_networks_sort_their_keys(exchange):
    """A constructor given its keys in the other order reads the same entries."""
    for make, keys in (
        (partial(CausalPredictor, depth=1, width=8), ("latent", ("agent", "action"))),
        (InverseDynamicsModel, ("latent", "next_latent")),
        (GoalPolicy, ("latent", ("goal", "latent"))),
    ):
        assert make(latent_dim=4, action_dim=4, in_keys=keys[:: -1 if exchange else 1]).in_keys == list(keys)


@pytest.mark.parametrize("keys", [("a", "b"), ("z", "u"), (("x", "1"), ("x", "2"))])
def test_without_names_position_decides(keys):
    assert arrange("predictor", keys, PREDICTOR) == ["latent", "action"]
    assert arrange("inverse_model", keys, INVERSE) == ["latent", "next_latent"]


@pytest.mark.parametrize(
    ("owner", "names", "keys"),
    [
        ("predictor", PREDICTOR, ("latent", ("obs", "latent"))),
        ("predictor", PREDICTOR, ("action", "action")),
        ("predictor", PREDICTOR, ("z", "z")),
        ("predictor", PREDICTOR, ("pixels", "action")),
        ("predictor", PREDICTOR, (("next", "latent"), "action")),
        ("inverse_model", INVERSE, ("latent", "action")),
        ("inverse_model", INVERSE, ("other", "latent")),
        ("inverse_model", INVERSE, ("next_latent", ("next", "latent"))),
        ("inverse_model", INVERSE, (("a", "latent"), ("b", "latent"))),
    ],
)
def test_names_that_contradict_each_other_are_refused_in_one_line(owner, names, keys):
    message = f"the {owner} gets .* do not say which is which: name them"
    with pytest.raises(ValueError, match=message) as caught:
        arrange(owner, keys, names)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    parts = dict(zip(FICRegLoss._networks, make_networks()))
    parts[owner] = TensorDictModule(parts[owner].module, list(keys), [OUT[owner]])
    loss = FICRegLoss(**parts, sigreg=SIGReg(4))
    with pytest.raises(ValueError, match=message):
        loss(make_clip())
    with pytest.raises(ValueError, match=message):
        if owner == "inverse_model":
            InverseConsistency(parts[owner])
        else:
            LatentWorldModel(parts["encoder"], parts[owner], frame_skip=2)


def test_set_keys_settles_what_names_leave_open():
    encoder, predictor, inverse_model = make_networks(0.0)
    keys = [("a", "latent"), ("b", "latent")]
    for first, second in itertools.permutations(keys):
        renamed = rewrap(predictor, (first, second), "hat", False)
        loss = FICRegLoss(encoder, renamed, inverse_model, sigreg=SIGReg(16)).eval()
        loss.set_keys(latent=first, action=second)
        clip = make_clip().rename_key_("action", second)
        expected = FICRegLoss(encoder, predictor, inverse_model, sigreg=SIGReg(16)).eval()(make_clip())
        torch.testing.assert_close(loss(clip), expected, rtol=0, atol=0)
