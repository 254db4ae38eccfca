"""Claim: the losses compile into one graph that computes what they compute."""

from __future__ import annotations

import pytest
import torch

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:tensordict.*")


def step(loss, call, clip):
    loss.zero_grad()
    torch.manual_seed(0)
    output = call(clip)
    sum(output.values()).backward()
    return output.detach(), [param.grad.clone() for param in loss.parameters()]


@pytest.mark.parametrize("context", ["detached", "live"])
def test_one_graph_gives_the_same_values_gradients_and_statistics(make_ficreg, make_clip, context):
    eager, graph = make_ficreg(0.0, context=context), make_ficreg(0.0, context=context)
    torch._dynamo.reset()
    compiled = torch.compile(graph, fullgraph=True, backend="aot_eager")
    for seed in range(2):
        expected, gradients = step(eager, eager, make_clip(seed=seed))
        output, ours = step(graph, compiled, make_clip(seed=seed))
        torch.testing.assert_close(output, expected)
        torch.testing.assert_close(ours, gradients)
    state = graph.state_dict()
    for key, value in eager.state_dict().items():
        torch.testing.assert_close(state[key], value)


@pytest.mark.slow
def test_the_default_backend_agrees(make_ficreg, make_clip, monkeypatch):
    from torch._inductor import config

    monkeypatch.setattr(config, "fallback_random", True)  # the random numbers of eager mode
    eager, graph = make_ficreg(0.0), make_ficreg(0.0)
    torch._dynamo.reset()
    expected, gradients = step(eager, eager, make_clip())
    output, ours = step(graph, torch.compile(graph, fullgraph=True), make_clip())
    torch.testing.assert_close(output, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours, gradients, rtol=1e-3, atol=1e-5)
