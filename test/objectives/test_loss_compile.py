"""Claims: the losses compile into one graph that computes what they compute, and agree in half precision."""

from __future__ import annotations

import pytest
import torch
from _loss_test_base import call, total
from loss_collection import COLLECTION, make_clip, make_loss
from torch._dynamo.testing import CompileCounterWithBackend

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:tensordict.*")
QUICK = ("paper",)  # the others take ten seconds each


def step(loss, function, clip):
    loss.zero_grad()
    torch.manual_seed(0)
    output = function(clip)
    total(output).backward()
    return output.detach(), [param.grad.clone() for param in loss.parameters()]


def coefficients(loss):
    return sorted(name for name, _ in loss.named_buffers() if name.endswith("_coeff"))


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in COLLECTION]
)
def test_one_graph_gives_the_same_values_gradients_and_statistics(name):
    """And is compiled once, whatever a schedule does to the coefficients."""
    eager, graph = make_loss(name, 0.0), make_loss(name, 0.0)
    torch._dynamo.reset()
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(graph, fullgraph=True, backend=counter)
    for seed in range(3):
        expected, gradients = step(eager, eager, make_clip(seed=seed))
        output, ours = step(graph, compiled, make_clip(seed=seed))
        torch.testing.assert_close(output, expected)
        torch.testing.assert_close(ours, gradients)
        for coefficient in coefficients(graph):
            for loss in (eager, graph):
                setattr(loss, coefficient, 0.3 * (seed + 1))
    assert counter.frame_count == 1
    state = graph.state_dict()
    for key, value in eager.state_dict().items():
        torch.testing.assert_close(state[key], value)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "trusted", "pldm"])  # one minute each
def test_the_default_backend_agrees(name):
    from torch._inductor import config

    eager, graph = make_loss(name, 0.0), make_loss(name, 0.0)
    torch._dynamo.reset()
    expected, gradients = step(eager, eager, make_clip())
    with config.patch(fallback_random=True):  # the random numbers of eager mode
        output, ours = step(graph, torch.compile(graph, fullgraph=True), make_clip())
    torch.testing.assert_close(output, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours, gradients, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_a_compiled_loss_gives_zeros_for_a_wholly_masked_batch():
    """Nothing is raised inside a graph; the terms are zero and every gradient is finite."""
    clip, loss = make_clip(), make_loss("paper", 0.0)
    clip["mask"] = torch.zeros(8, 3, dtype=torch.bool)
    torch._dynamo.reset()
    output, gradients = step(loss, torch.compile(loss, fullgraph=True, backend="aot_eager"), clip)
    assert [output[term].item() for term in ("loss_pred", "loss_idm", "loss_consistency")] == [0, 0, 0]
    assert all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("name", COLLECTION)
def test_half_precision_agrees(name):
    """Under bfloat16 autocast terms are float32, within 5 % or 0.02, and the cosine of gradients is over 0.98."""
    full, half = make_loss(name, 0.0), make_loss(name, 0.0)
    expected = call(full, make_clip(32))
    with torch.autocast("cpu", torch.bfloat16):
        output = call(half, make_clip(32))
    for term in COLLECTION[name][3]:
        assert output[term].dtype == torch.float32
        torch.testing.assert_close(output[term], expected[term], rtol=0.05, atol=0.02)
    total(expected).backward()
    total(output).backward()
    for network in full._networks:
        flat = [
            torch.cat([param.grad.flatten() for param in getattr(loss, f"{network}_params").parameters()])
            for loss in (full, half)
        ]
        assert torch.cosine_similarity(*flat, dim=0) > 0.98, network
