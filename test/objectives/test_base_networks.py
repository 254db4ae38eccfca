"""Claims about networks of a user's own in a loss: own keys, own classes, several outputs, errors inside and wrong widths."""

from __future__ import annotations

import pytest
import torch
from _losses import call, make_clip, make_loss, make_networks, total
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from torchrl_ficreg import CausalPredictor, FICRegLoss, InverseDynamicsModel, LeWMLoss, SIGReg


def _narrow(in_keys, out_keys, keep=1):
    """A module that keeps so many dimensions of its first input, the last of them 1 wide, for each output."""

    def narrow(*inputs):
        value = inputs[0].float().flatten(keep - 1 if keep > 1 else 0)[..., :1]
        return (value,) * len(out_keys) if len(out_keys) > 1 else value

    return TensorDictModule(narrow, list(in_keys), list(out_keys))


def test_set_keys_selects_among_several_outputs():
    """Constructors ask for nothing that set_keys can still say."""
    reference, clip = make_loss("paper", 0.0), make_clip()
    encoder, predictor, inverse_model = make_networks(0.0)

    def twice(module, in_keys, out_keys):
        return TensorDictSequential(module, TensorDictModule(lambda x: -x, in_keys, out_keys))

    loss = FICRegLoss(
        twice(encoder, ["latent"], ["skip"]),
        twice(CausalPredictor.select_out_keys(predictor, "predicted_latent"), ["predicted_latent"], [("x", "hat")]),
        twice(inverse_model, ["recovered_action"], ["flipped"]),
        sigreg=SIGReg(16),
    )
    torch.testing.assert_close(call(loss, clip), call(reference, clip))
    other = FICRegLoss(loss.encoder, loss.predictor, loss.inverse_model, sigreg=SIGReg(16))
    other.set_keys(latent="latent", predicted_latent=("x", "hat"), recovered_action="flipped")
    assert not call(other, clip)["loss_pred"].equal(call(reference, clip)["loss_pred"])


class _Fails(nn.Linear):
    """A network that runs out of memory, or raises another error, at its n-th call."""

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
def test_an_error_inside_leaves_the_networks_usable(failing, at, error):
    """Catch, make the batch smaller, go on: no frozen weight and no borrowed buffer stays behind.

    Errors that a signal handler raises in the middle of a forward pass arrive as they are, too.
    """
    encoder, predictor, inverse_model = make_networks()
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
    total(loss(make_clip())).backward()
    assert all(param.grad is not None for param in params)


OTHER_WIDTH = r"the shape of its target, got \[8, 2, 1\] for \[8, 2, 6\]"


@pytest.mark.parametrize(
    ("name", "network", "error", "message"),
    [
        ("encoder", _narrow(("pixels",), ("latent",), keep=2), ValueError, "the encoder must map pixels"),
        ("encoder", _narrow(("pixels",), ("latent",), keep=5), ValueError, r"encoder must map pixels \[B, T, 3, H, W\]"),
        ("predictor", _narrow(("latent", "action"), ("predicted_latent",), keep=3), ValueError, OTHER_WIDTH),
        ("inverse_model", _narrow(("latent", "after"), ("recovered_action",), keep=3), ValueError, OTHER_WIDTH),
        ("encoder", _narrow(("pixels", "action"), ("latent",)), ValueError, "the encoder must read 1 entries, it reads"),
        ("predictor", _narrow(("latent",), ("predicted_latent",)), ValueError, "the predictor must read 2 entries, it reads"),
        ("inverse_model", _narrow(("latent",), ("a",)), ValueError, "the inverse_model must read 2 entries, it reads"),
        *(
            (name, network, TypeError, f"the {name} must be a TensorDictModule, got a .*: wrap a network as")
            for name in FICRegLoss._networks
            for network in (nn.Linear(2, 2), None)
        ),
    ],
)
def test_wrong_networks_are_refused_and_never_broadcast(name, network, error, message):
    """By the constructor where it can: widths are known at the first call only."""
    networks = {**dict(zip(FICRegLoss._networks, make_networks())), name: network}
    at_the_call = message == OTHER_WIDTH or "must map" in message
    loss = FICRegLoss(**networks, sigreg=SIGReg(4)) if at_the_call else None
    with pytest.raises(error, match=message):
        loss(make_clip()) if at_the_call else FICRegLoss(**networks)


def test_a_key_that_no_network_writes_is_named_at_the_first_call():
    encoder, predictor, _ = make_networks()
    loss = FICRegLoss(encoder, predictor, InverseDynamicsModel(6, 6, 8, kind="gaussian"), sigreg=SIGReg(4))
    loss.set_keys(recovered_action="guess")
    with pytest.raises(KeyError, match="no 'latent' among .*'code', 'skip'.*: see set_keys"):
        LeWMLoss(_narrow(("pixels",), ("code", "skip"), keep=3), predictor)(make_clip())
    with pytest.raises(KeyError, match="no 'guess' among .*'recovered_action'.*: see set_keys"):
        loss(make_clip())
