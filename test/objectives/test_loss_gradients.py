"""Claim: the gradient of every term is its derivative, by finite differences in float64."""

from __future__ import annotations

import pytest
import torch
from _loss_test_base import call
from loss_collection import COLLECTION, make_clip, make_loss
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import InverseDynamicsModel, LeWMLoss, SIGReg
from torchrl_ficreg.objectives import JointInverseLoss, PLDMLoss

# A term that also depends on a network through something detached has no derivative to compare with.
CASES = [
    (name, term, network)
    for name, (_, _, _, table) in COLLECTION.items()
    for term, row in table.items()
    for network, reached in row.items()
    if reached and not (term == "loss_consistency" and (network == "encoder" or name.startswith("two_steps")))
]


@pytest.mark.parametrize(("name", "term", "network"), CASES)
def test_along_a_random_direction_of_the_parameters(name, term, network):
    loss, clip = make_loss(name).double().eval(), make_clip(4)
    clip["pixels"], clip["action"] = clip["pixels"].double() / 255, clip["action"].double()
    params = list(getattr(loss, f"{network}_params").parameters())
    gradients = torch.autograd.grad(call(loss, clip)[term], params, allow_unused=True)
    torch.manual_seed(1)
    directions = [torch.randn_like(param) for param in params]
    expected = sum((grad * way).sum() for grad, way in zip(gradients, directions) if grad is not None)
    values = []
    for step in (1e-6, -2e-6):
        with torch.no_grad():
            for param, way in zip(params, directions):
                param.add_(step * way)
            values.append(call(loss, clip)[term])
    torch.testing.assert_close((values[0] - values[1]) / 2e-6, expected, rtol=1e-4, atol=1e-8)


class _Flat(nn.Module):
    def forward(self, pixels):
        return pixels.flatten(-3)


class _Step(nn.Linear):
    def forward(self, latent, action):
        return torch.tanh(super().forward(torch.cat([latent, action], -1)))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("make", [LeWMLoss, JointInverseLoss, PLDMLoss])
def test_gradcheck_of_every_live_term_by_latents(make, masked):
    """With pixels for latents: an encoder that only flattens."""
    torch.manual_seed(0)
    networks = [
        TensorDictModule(_Flat(), ["pixels"], ["latent"]),
        TensorDictModule(_Step(3 + 2, 3), ["latent", "action"], ["predicted_latent"]),
        InverseDynamicsModel(3, 2, 4),
    ]
    arguments = {"time_cov_coeff": 1.0} if make is PLDMLoss else {"sigreg": SIGReg(4)}
    loss = make(*networks[: 2 if make is LeWMLoss else 3], **arguments).double().eval()
    latent = 0.5 * torch.randn(4, 3, 3, 1, 1, dtype=torch.float64)
    clip = TensorDict({"action": torch.randn(4, 3, 2, dtype=torch.float64)})
    if masked:
        clip["mask"] = torch.tensor([[1, 1, 1], [1, 0, 1], [0, 0, 1], [1, 1, 0]], dtype=torch.bool)

    def terms(pixels):
        return tuple(loss(clip.copy().set("pixels", pixels)).values())

    assert torch.autograd.gradcheck(terms, latent.requires_grad_())
