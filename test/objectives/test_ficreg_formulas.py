"""Values and gradients of the four terms of FICReg are those of the published formulas, in float64.

With z_t the latent of frame t, p_{t+1} the prediction of the next one from z_1 .. z_t and a_t, h the inverse model and
sg[...] a constant, for clips of history + 1 = 3 frames, means over the batch, time and components::

    L_pred   = mean |p_{t+1} - z_{t+1}|^2                      no stop-gradient anywhere
    L_sigreg = mean over t and directions u of B integral_{-3}^{3} |phi_u(s) - exp(-s^2 / 2)|^2 exp(-s^2 / 2) ds
               phi_u(s) = mean over the batch of exp(i s <u, z_t>), the integral by the trapezoidal rule at 33 knots
    L_idm    = mean |h(sg[z_t], sg[z_{t+1}]) - a_t|^2          reaches h alone
    L_cons   = mean |h_sg(sg[z_t], p_{t+1}) - a_t|^2           h_sg: the parameters of h as constants
               live:     p_{t+1} of L_pred (Algorithm 1)       reaches encoder and predictor
               detached: p_{t+1} anew, from sg[z_1] .. sg[z_t] reaches the predictor alone (the text of section 2.2)

weighted by 1, lambda, mu and gamma.
"""

from __future__ import annotations

import copy

import pytest
import torch
from _losses import LATENT, make_clip, make_networks
from tensordict import TensorDict
from torch import nn

from torchrl_ficreg import FICRegLoss, SIGReg

HISTORY, DIRECTIONS = 2, 5
LAMBDA, MU, GAMMA = 0.25, 0.75, 2.0  # exact in the float32 that a coefficient is kept in


def normality(latent: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """L_sigreg of latents [B, T, D] along directions [D, M]."""
    knots = torch.linspace(-3, 3, 33, dtype=torch.float64)
    gaussian = (-knots.square() / 2).exp()
    phase = knots * (latent @ directions).unsqueeze(-1)  # [B, T, M, 33]
    real, imaginary = phase.cos().mean(0), phase.sin().mean(0)
    distance = ((real - gaussian).square() + imaginary.square()) * gaussian
    return len(latent) * torch.trapezoid(distance, knots).mean()


def formulas(networks: dict[str, nn.Module], clip: TensorDict, directions: torch.Tensor, context: str) -> dict:
    """The four weighted terms, as above."""
    encoder, predictor, inverse = (network.module for network in networks.values())
    constants = {name: param.detach() for name, param in inverse.named_parameters()}
    action = clip["action"][:, :HISTORY]
    latent = encoder(clip["pixels"])
    before, after = latent[:, :HISTORY], latent[:, 1:]
    predicted = predictor(before, action)
    imagined = predicted if context == "live" else predictor(before.detach(), action)
    recovered = torch.func.functional_call(inverse, constants, (before.detach(), imagined))
    return {
        "loss_pred": (predicted - after).square().mean(),
        "loss_sigreg": LAMBDA * normality(latent, directions),
        "loss_idm": MU * (inverse(before.detach(), after.detach()) - action).square().mean(),
        "loss_consistency": GAMMA * (recovered - action).square().mean(),
    }


@pytest.mark.parametrize("context", ["live", "detached"])
def test_values_and_gradients_are_those_of_the_formulas(context):
    """Of every term for every network, in training, to eight digits and more."""
    networks = {name: network.double() for name, network in zip(FICRegLoss._networks, make_networks(dropout=0.0))}
    theirs, sigreg = copy.deepcopy(networks), SIGReg(DIRECTIONS)
    loss = FICRegLoss(
        *networks.values(), sigreg=sigreg, sigreg_coeff=LAMBDA, idm_coeff=MU, consistency_coeff=GAMMA, context=context
    ).double()
    directions = sigreg.eval()._draw(LATENT).double()
    clip = make_clip(6, frames=HISTORY + 1)
    clip["action"] = clip["action"].double()
    output, expected = loss(clip), formulas(theirs, clip, directions, context)
    assert set(output.keys()) == set(expected)
    for term, value in expected.items():
        assert output[term].dtype == torch.float64
        torch.testing.assert_close(output[term], value, rtol=1e-9, atol=1e-12)
        for name, network in theirs.items():
            params, kwargs = dict(network.named_parameters()), {"retain_graph": True, "materialize_grads": True}
            ours = getattr(loss, f"{name}_params").flatten_keys(".")
            found = torch.autograd.grad(output[term], [ours[key] for key in params], **kwargs)
            wanted = torch.autograd.grad(value, list(params.values()), **kwargs)
            torch.testing.assert_close(dict(zip(params, found)), dict(zip(params, wanted)), rtol=1e-8, atol=1e-12)
