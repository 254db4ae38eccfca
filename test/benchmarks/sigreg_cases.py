"""SIGReg and the plain formulation on [4, 128, 192] with 1024 directions, and ways to weigh them."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from torchrl_ficreg import SIGReg


class PlainSIGReg(torch.nn.Module):
    """One sine and one cosine for every knot, as published (arXiv 2511.08544)."""

    def __init__(self) -> None:
        super().__init__()
        knots = torch.linspace(0, 3, 17)
        weights = torch.full((17,), 2 * 3 / 16)
        weights[[0, -1]] = 3 / 16
        gaussian = torch.exp(-knots.square() / 2)
        self.register_buffer("knots", knots)
        self.register_buffer("gaussian", gaussian)
        self.register_buffer("weights", weights * gaussian)

    def forward(self, latent: torch.Tensor, directions: torch.Tensor | None = None) -> torch.Tensor:
        """Latents [T, B, D] -> []."""
        if directions is None:
            directions = torch.randn(latent.shape[-1], 1024)
            directions = directions / directions.norm(dim=0)
        angle = (latent @ directions).unsqueeze(-1) * self.knots  # [T, B, M, 17]
        error = (angle.cos().mean(-3) - self.gaussian).square() + angle.sin().mean(-3).square()  # [T, M, 17]
        return ((error @ self.weights) * latent.shape[-2]).mean()


CASES = {"ours": SIGReg, "plain": PlainSIGReg}


def latents() -> torch.Tensor:
    """Standard normal latents [4, 128, 192] that want a gradient."""
    return torch.randn(4, 128, 192, generator=torch.Generator().manual_seed(0)).requires_grad_()


def forward_backward(module: torch.nn.Module, latent: torch.Tensor) -> None:
    """One training use."""
    latent.grad = None
    module(latent).backward()


def best_time(call: Callable[[], None], rounds: int) -> float:
    """Seconds of the fastest of so many calls, after one more."""
    call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def saved_bytes(module: torch.nn.Module, latent: torch.Tensor) -> int:
    """Bytes of the distinct tensors kept for the backward pass."""
    storages: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        value = module(latent)
    del value
    return sum(storage.nbytes() for storage in storages.values())


def peak_bytes(module: torch.nn.Module, latent: torch.Tensor) -> int:
    """Most bytes allocated at once during one training use, by the allocator's own record."""
    latent.grad = None
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        module(latent).backward()
    level = peak = 0
    for event in profile.profiler.kineto_results.events():
        if event.name() == "[memory]":
            level += event.nbytes()
            peak = max(peak, level)
    return peak
