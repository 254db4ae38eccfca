"""Claims about inverse dynamics models: what each kind of network reads, and wrong arguments."""

from __future__ import annotations

import pytest
import torch

from torchrl_ficreg import InverseDynamicsModel


def test_a_transformer_is_causal_and_reads_history():
    torch.manual_seed(0)
    model = InverseDynamicsModel(4, 3, 16, kind="transformer", history=5).eval().module
    latent, after = torch.randn(2, 5, 4).requires_grad_(), torch.randn(2, 5, 4).requires_grad_()
    reached = []
    for step in range(5):
        grads = torch.autograd.grad(model(latent, after)[:, step].sum(), (latent, after))
        reached.append([[bool(row.any()) for row in grad.transpose(0, 1)] for grad in grads])
    for step, (history, imagined) in enumerate(reached):
        assert history == [at <= step for at in range(5)]
        assert imagined == [at == step for at in range(5)]
    with pytest.raises(ValueError, match="takes 1 to 5 latents, got 6: .* history=6"):
        model(torch.zeros(2, 6, 4), torch.zeros(2, 6, 4))


@pytest.mark.parametrize("kind", ["mlp", "gaussian", "ensemble"])
def test_other_networks_read_one_transition_only(kind):
    model = InverseDynamicsModel(4, 3, 16, kind=kind)
    latent, after = torch.randn(2, 5, 4), torch.randn(2, 5, 4)
    whole, single = model.module(latent, after), model.module(latent[:, 2], after[:, 2])
    for one, other in [(whole, single)] if kind == "mlp" else zip(whole, single, strict=True):
        torch.testing.assert_close(one[:, 2], other)


def test_wrong_inverse_models_are_refused():
    with pytest.raises(ValueError, match="unknown kind of inverse model 'linear': choose one of"):
        InverseDynamicsModel(4, 3, kind="linear")
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        InverseDynamicsModel(4, 3, kind="ensemble", members=1)
