"""Claim: the gradient of every term is its derivative, by finite differences in float64."""

from __future__ import annotations

import pytest
import torch
from _losses import call, COLLECTION, FICREG, LOSSES, make_clip, make_loss, make_mask

# Terms that a variant of FICReg shares with "paper" are left out. A term that also depends on a network through something
# detached has no derivative to compare with.
CASES = [
    (name, term, network, masked)
    for name, (_, _, _, table) in COLLECTION.items()
    for term, row in table.items()
    for network, reached in row.items()
    for masked in ((False, True) if name in LOSSES else (False,))
    if reached
    and not (name != "paper" and name in FICREG and term in ("loss_pred", "loss_sigreg"))
    and not (term == "loss_consistency" and (network == "encoder" or name.startswith("two_steps")))
]


@pytest.mark.parametrize(("name", "term", "network", "masked"), CASES)
def test_along_a_random_direction_of_the_parameters(name, term, network, masked):
    loss, clip = make_loss(name).double().eval(), make_clip(4)
    clip["pixels"], clip["action"] = clip["pixels"].double() / 255, clip["action"].double()
    if masked:
        clip["mask"] = make_mask(4)
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
