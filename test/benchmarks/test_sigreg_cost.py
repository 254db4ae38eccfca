"""Claim: SIGReg is at least 3 times faster than the plain formulation, in at most a quarter of its memory."""

from __future__ import annotations

import torch
from sigreg_cases import best_time, CASES, forward_backward, latents, peak_bytes, PlainSIGReg, saved_bytes

from torchrl_ficreg import SIGReg


def test_it_is_faster_and_smaller_than_the_plain_formulation():
    latent = latents()
    modules = {name: make() for name, make in CASES.items()}
    seconds, saved, peak = {}, {}, {}
    for name, module in modules.items():
        seconds[name] = best_time(lambda module=module: forward_backward(module, latent), 7)
        saved[name] = saved_bytes(module, latent)
        peak[name] = peak_bytes(module, latent)
        sizes = f"saved {saved[name] / 2**20:.1f} MiB, peak {peak[name] / 2**20:.1f} MiB"
        print(f"{name}: {1e3 * seconds[name]:.1f} ms, {sizes}")
    assert seconds["plain"] >= 3 * seconds["ours"]
    assert 4 * saved["ours"] <= saved["plain"]
    assert 4 * peak["ours"] <= peak["plain"]


def test_both_compute_the_same():
    """At this size too: value and gradient within 1e-5, given the same directions."""
    latent, ours = latents(), SIGReg()
    directions = SIGReg().eval()._draw(192)
    value, expected = ours(latent), PlainSIGReg()(latent, directions)
    gradients = [torch.autograd.grad(each, latent)[0] for each in (value, expected)]
    assert ((value - expected) / expected).abs() < 1e-5
    assert (gradients[0] - gradients[1]).norm() < 1e-5 * gradients[1].norm()
