"""Claims about the device: precision follows a measurement, convolutions have their own; freed memory is reused."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import nn
from torch._subclasses import FakeTensorMode

from torchrl_ficreg import _device as precision, ConvEncoder, KeypointEncoder, ViTEncoder
from torchrl_ficreg._device import autocast, bf16_speedup, describe_precision, has_fast_bf16, uses_bf16


@pytest.fixture
def speeds(monkeypatch):
    """``speeds(products, convolutions)`` sets the measured speedups."""

    def set_speeds(products: float, convolutions: float) -> None:
        known = {"products": products, "convolutions": convolutions}
        monkeypatch.setattr(precision, "bf16_speedup", lambda kind="products": known[kind])

    return set_speeds


@pytest.fixture
def unmeasured(monkeypatch):
    """A process that has measured nothing yet."""
    monkeypatch.setattr(precision, "_speedups", {})


@pytest.mark.parametrize("kind", ["products", "convolutions"])
def test_the_speed_of_bfloat16_is_measured_once_and_leaves_no_trace(unmeasured, kind):
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        measured = bf16_speedup(kind)
    assert 0 < measured < 1000 and bf16_speedup(kind) == measured
    assert torch.get_rng_state().equal(state) and torch.get_num_threads() == threads


def run_fake(ask):
    with FakeTensorMode():
        ask()


CONTEXTS = {
    "torch.compile": lambda ask: torch.compile(lambda x: x * ask(), backend="eager", fullgraph=True)(torch.ones(2)),
    "torch.vmap": lambda ask: torch.vmap(lambda x: x * ask())(torch.ones(2)),
    "torch.func.grad": lambda ask: torch.func.grad(lambda x: x * ask())(torch.ones(())),
    "fake tensors": run_fake,
    "torch.jit.trace": lambda ask: torch.jit.trace(lambda x: x * ask(), torch.ones(2)),
}


@pytest.mark.parametrize("kind", ["products", "convolutions"])
@pytest.mark.parametrize("context", CONTEXTS)
def test_it_can_be_measured_first_wherever_it_is_asked_for(unmeasured, monkeypatch, context, kind):
    """On real tensors, whatever kind of tensors the caller uses."""
    measure, seen = precision._measure, []

    def watched(kind):
        seen.append(type(torch.ones(2)) is torch.Tensor and not torch._C._are_functorch_transforms_active())
        return measure(kind)

    monkeypatch.setattr(precision, "_measure", watched)
    CONTEXTS[context](lambda: bf16_speedup(kind))
    assert seen == [True] and bf16_speedup(kind) > 0 and seen == [True]


def test_threads_that_ask_together_wait_for_one_measurement(unmeasured):
    """And a thread that starts later has as many threads to compute with as before."""
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(lambda _: bf16_speedup(), range(4)))) == 1
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch.get_num_threads).result() == threads


FAULTS = """
import sys, torch
from torchrl_ficreg._device import describe_precision, keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        torch.ones(2**23)  # 32 MiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

if sys.platform == "linux":
    import resource
    known = keep_freed_memory(2**20, allow_decrease=True)
    fresh = faults()
    keep_freed_memory(2**31 - 1)
    faults()
    kept = faults()
    keep_freed_memory(2**20)
    print(int(known), fresh, kept, faults())
print(describe_precision("cpu"))
"""


@pytest.fixture(scope="module")
def said() -> list[str]:
    """Lines of a process whose heap has no holes yet, and which has no instructions for bfloat16."""
    env = os.environ | {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE"}
    done = subprocess.run([sys.executable, "-c", FAULTS], env=env, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_instructions_that_are_switched_off_are_noticed(said):
    """oneDNN computes bfloat16 without the instructions too, slower than float32: ``auto`` is fp32 then."""
    assert said[-1].startswith("cpu, fp32 (") and "x in products" in said[-1] and "x in convolutions" in said[-1]


@pytest.mark.skipif(sys.platform != "linux", reason="a setting of glibc")
def test_freed_memory_is_reused_and_a_smaller_setting_does_not_undo_a_larger_one(said):
    """Counted in page faults, one per page or huge page of fresh memory."""
    known, fresh, kept, after_decrease = map(int, said[0].split())
    if not known:
        pytest.skip("another C library")
    assert kept < fresh / 4 and after_decrease < fresh / 4


@pytest.mark.parametrize("products, convolutions", [(2.0, 2.0), (10.0, 0.2), (0.4, 2.0)])
def test_auto_follows_the_products_and_says_why(speeds, products, convolutions):
    speeds(products, convolutions)
    assert uses_bf16("cpu") == has_fast_bf16("cpu") == (products > 1)
    assert has_fast_bf16("cpu", "convolutions") == (convolutions > 1)
    said = describe_precision("cpu")
    assert said.startswith("cpu, bf16" if products > 1 else "cpu, fp32")
    assert f"{products:.1f} x in products, {convolutions:.1f} x in convolutions" in said
    assert uses_bf16("cpu", "bf16") and not uses_bf16("cpu", "fp32")
    assert not has_fast_bf16("mps") and describe_precision("mps") == "mps, fp32"


@pytest.mark.parametrize("make", [ConvEncoder, KeypointEncoder])
@pytest.mark.parametrize("chosen", ["auto", "bf16"])
@pytest.mark.parametrize("convolutions", [2.0, 0.2])
def test_convolutions_are_in_bfloat16_only_where_that_is_fast(speeds, make, chosen, convolutions):
    """The other layers are not asked: they stay in bfloat16. Outside of autocast nothing changes."""
    speeds(2.0, convolutions)
    encoder, seen = make(image_size=32).eval(), set()
    for layer in encoder.modules():
        if isinstance(layer, nn.Conv2d):
            layer.register_forward_hook(lambda module, given, result: seen.add(result.dtype))
    pixels = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    with autocast("cpu", chosen), torch.no_grad():
        encoder(pixels=pixels)
        assert torch.is_autocast_enabled("cpu")
    assert seen == {torch.bfloat16 if convolutions > 1 else torch.float32}
    seen.clear()
    encoder(pixels=pixels)
    assert seen == {torch.float32}


@pytest.mark.parametrize("make", [ConvEncoder, KeypointEncoder])
@pytest.mark.parametrize("convolutions", [2.0, 0.2])
def test_either_choice_trains_to_the_same_gradient(speeds, make, convolutions):
    """Up to bfloat16's rounding, in gradients of the parameters' own dtype."""
    speeds(2.0, convolutions)
    torch.manual_seed(0)
    encoder = make(image_size=32).eval()
    pixels = torch.randint(0, 256, (8, 3, 32, 32), dtype=torch.uint8)
    gradients = []
    for chosen in ("fp32", "auto"):
        with autocast("cpu", chosen):
            loss = encoder(pixels=pixels).float().square().mean()
        gradients.append(torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(encoder.parameters()))]))
    assert gradients[1].dtype == torch.float32
    assert torch.cosine_similarity(*gradients, dim=0) > 0.99


def test_a_compiled_encoder_keeps_the_choice(speeds):
    speeds(2.0, 0.2)
    encoder = ConvEncoder(image_size=32).eval()
    compiled = torch.compile(encoder.module, backend="eager", fullgraph=True)
    pixels = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    with torch.no_grad(), autocast("cpu", "bf16"):
        torch.testing.assert_close(compiled(pixels), encoder.module(pixels))


@pytest.mark.parametrize("grad", [True, False])
@pytest.mark.parametrize("chosen", ["fp32", "bf16"])
def test_a_vision_transformer_gives_the_same_latents_by_every_path(grad, chosen):
    """The kernel of attention differs between training and inference, and between the two precisions."""
    torch.manual_seed(0)
    encoder = ViTEncoder(image_size=28, patch_size=7, depth=2).eval()
    pixels = torch.randint(0, 256, (3, 3, 28, 28), dtype=torch.uint8)
    expected = encoder(pixels=pixels).detach()
    with torch.set_grad_enabled(grad), autocast("cpu", chosen):
        latent = encoder(pixels=pixels).detach().float()
    tolerance = 1e-5 if chosen == "fp32" else 5e-2 * expected.abs().max().item()
    torch.testing.assert_close(latent, expected, rtol=0, atol=tolerance)
