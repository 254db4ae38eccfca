"""Claim: the terms and weights of PLDM are the published ones."""

from __future__ import annotations

import pytest
import torch
from _losses import make_clip, make_networks

from torchrl_ficreg.objectives import PLDMLoss


def test_terms_and_weights_are_the_published_ones():
    """From the definitions of stable-worldmodel's ``wm/loss.py``, whose recipe has the default weights."""
    weights = {"var": 18.0, "cov": 12.0, "time_sim": 0.2, "time_var": 0.7, "time_cov": 0.0, "idm": 0.0}
    loss = PLDMLoss(*make_networks(0.0)).eval()
    assert {name: getattr(loss, f"{name}_coeff").item() for name in weights} == pytest.approx(weights)
    assert loss.out_keys == ["loss_pred", "loss_var", "loss_cov", "loss_time_sim", "loss_time_var"]
    loss = PLDMLoss(*make_networks(0.0), time_cov_coeff=1.0).eval()
    clip = make_clip(frames=3)
    latent, found = loss.peek(clip).transpose(0, 1), loss(clip)  # [B, T, D]
    centred = latent - latent.mean(0)
    off = ~torch.eye(6, dtype=torch.bool)

    def moments(rows):  # of N centred rows [..., N, D]: mean square of the entries off the diagonal
        return (rows.transpose(-2, -1) @ rows / (rows.shape[-2] - 1))[..., off].square().mean()

    def hinge(rows):
        return torch.relu(1 - (rows.var(-2) + 1e-4).sqrt()).mean()

    over_batch = centred.transpose(0, 1)  # [T, B, D]
    expected = {
        "loss_var": 18 * hinge(over_batch),
        "loss_cov": 12 * moments(over_batch),
        "loss_time_sim": 0.2 * (latent[:, 1:] - latent[:, :-1]).square().mean(),
        "loss_time_var": 0.7 * hinge(centred),
        "loss_time_cov": moments(centred),
    }
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value)
