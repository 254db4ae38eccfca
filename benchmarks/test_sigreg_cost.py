"""Claims about SIGReg beside its plain formulation, on latents [4, 128, 192] with 1,024 directions.

1.  Value and gradient are the same, given the same directions.
2.  It is at least 3 times faster.
3.  It saves at most a quarter of the bytes for the backward pass, and allocates at most a quarter at its peak.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable

import pytest
import torch
from baselines import PlainSIGReg

from torchrl_ficreg import SIGReg

CASES = {"ours": SIGReg, "plain": PlainSIGReg}


def latents() -> torch.Tensor:
    """Standard normal latents [4, 128, 192] that require a gradient."""
    return torch.randn(4, 128, 192, generator=torch.Generator().manual_seed(0)).requires_grad_()


def forward_backward(module: torch.nn.Module, latent: torch.Tensor) -> None:
    """One forward and backward pass."""
    latent.grad = None
    module(latent).backward()


def best_time(call: Callable[[], None], rounds: int) -> float:
    """Seconds of the fastest of ``rounds`` calls, after one to warm up."""
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def saved_bytes(module: torch.nn.Module, latent: torch.Tensor) -> int:
    """Bytes of the distinct tensors saved for the backward pass."""
    storages: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        value = module(latent)
    del value
    return sum(storage.nbytes() for storage in storages.values())


def peak_bytes(module: torch.nn.Module, latent: torch.Tensor) -> int:
    """Largest number of bytes allocated at once during a forward and backward pass, as recorded by the allocator."""
    latent.grad = None
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        module(latent).backward()
    level = peak = 0
    for event in profile.profiler.kineto_results.events():
        if event.name() == "[memory]":
            level += event.nbytes()
            peak = max(peak, level)
    return peak


def test_both_compute_the_same():
    """Value and gradient within 1e-5."""
    latent, ours = latents(), SIGReg()
    directions = SIGReg().eval()._draw(192)
    value, expected = ours(latent), PlainSIGReg()(latent, directions)
    gradients = [torch.autograd.grad(each, latent)[0] for each in (value, expected)]
    assert ((value - expected) / expected).abs() < 1e-5
    assert (gradients[0] - gradients[1]).norm() < 1e-5 * gradients[1].norm()


def test_it_is_faster_than_the_plain_formulation():
    latent = latents()
    seconds = {name: best_time(lambda module=make(): forward_backward(module, latent), 3) for name, make in CASES.items()}
    assert seconds["plain"] >= 3 * seconds["ours"], seconds


@pytest.mark.parametrize("measure", [saved_bytes, peak_bytes])
def test_it_needs_less_memory_than_the_plain_formulation(measure):
    used = {name: measure(make(), latents()) for name, make in CASES.items()}
    assert 4 * used["ours"] <= used["plain"], used


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("pytest_benchmark") is None, reason="needs pytest-benchmark")
@pytest.mark.parametrize("name", CASES)
def test_time_of_sigreg(benchmark, name):
    module, latent = CASES[name](), latents()
    benchmark.pedantic(forward_backward, (module, latent), rounds=7, warmup_rounds=1)
