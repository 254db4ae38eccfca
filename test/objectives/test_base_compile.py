"""Claims: losses agree with themselves compiled, in half precision, under torch.func, on fake and on meta tensors."""

from __future__ import annotations

import copy

import pytest
import torch
from _losses import call, coefficients, COLLECTION, LOSSES, make_clip, make_loss, total
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounterWithBackend
from torch._subclasses import FakeTensor, FakeTensorMode

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:tensordict.*")
QUICK = ("paper",)  # the others take ten seconds each
each_class = pytest.mark.parametrize("name", LOSSES)


def step(loss, function, clip):
    loss.zero_grad()
    torch.manual_seed(0)
    output = function(clip)
    total(output).backward()
    return output.detach(), [param.grad.clone() for param in loss.parameters()]


@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in COLLECTION])
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


@pytest.mark.parametrize("name", [*LOSSES, "trusted", "nll", "ensemble", "transformer", "two_steps"])
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


@each_class
def test_a_loss_can_be_called_with_other_parameters(name):
    """By TensorDict.to_module, as the error of torch.func.functional_call says, which would not replace them."""
    clip, loss = make_clip(), make_loss(name).eval()
    params = {name: param.detach() * 1.1 for name, param in loss.named_parameters()}
    before = call(loss, clip)
    with pytest.raises(TypeError, match="write `with TensorDict.*to_module"):
        torch.func.functional_call(loss, params, (clip,))
    with TensorDict(params).unflatten_keys(".").to_module(loss):
        found = call(loss, clip)
    torch.testing.assert_close(call(loss, clip), before, rtol=0, atol=0)
    changed = copy.deepcopy(loss)
    with torch.no_grad():
        for name, param in changed.named_parameters():
            param.copy_(params[name])
    torch.testing.assert_close(found, call(changed, clip))


@each_class
def test_a_loss_can_be_mapped_over_clips(name):
    """torch.vmap over a leading dimension of data, in eval mode, is the loop over it."""
    clips, loss = make_clip(2, 8), make_loss(name).eval()
    mapped = torch.vmap(lambda pixels, action: loss(pixels, action))(clips["pixels"], clips["action"])
    for key, *found in zip(loss.out_keys, mapped, strict=True):
        torch.testing.assert_close(found[0], torch.stack([call(loss, clip)[key] for clip in clips]))


@each_class
@pytest.mark.parametrize("floats", [True, False])
def test_a_loss_runs_on_fake_tensors(name, floats):
    """They have a device, and no values that could be checked."""
    loss, mode = make_loss(name), FakeTensorMode(allow_non_fake_inputs=True)
    clip = make_clip().set("mask", torch.ones(8, 3, dtype=torch.bool))
    clip["pixels"] = clip["pixels"] / 255 if floats else clip["pixels"]
    with mode:
        output = loss(clip.apply(mode.from_tensor))
        assert all(isinstance(value, FakeTensor) and value.shape == () for value in output.values())


def test_torch_func_differentiates_a_loss_by_its_parameters():
    """One gradient for each batch, with parameters replaced as the class documents."""
    loss, clips = make_loss("paper").eval(), make_clip(2, 8)
    params = {name: param.detach() for name, param in loss.named_parameters()}

    def objective(params, clip):
        with TensorDict(params).unflatten_keys(".").to_module(loss):
            return total(loss(clip))

    found = torch.vmap(torch.func.grad(objective), (None, 0))(params, clips)
    for place, clip in enumerate(clips):
        gradients = torch.autograd.grad(total(loss(clip)), list(loss.parameters()))
        for name, gradient in zip(params, gradients, strict=True):
            torch.testing.assert_close(found[name][place], gradient, rtol=1e-4, atol=1e-5)


@each_class
def test_a_loss_runs_on_meta_tensors(name):
    """They have neither values nor autocast: terms have the right shape, and a gradient."""
    with torch.device("meta"):
        loss = make_loss(name)
    output = loss(make_clip().to("meta"))
    assert all(value.shape == () and value.device.type == "meta" for value in output.values())
    total(output).backward()
