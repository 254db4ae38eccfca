"""Claims about LatentHealth: no alarm on a Gaussian of any shape, one at collapse, at low rank and at NaN."""

from __future__ import annotations

import math

import pytest
import torch
from _losses import noise

from torchrl_ficreg import SIGReg
from torchrl_ficreg.objectives import latent_health


@pytest.mark.parametrize("shape", [(4, 512, 64), (128, 192), (32, 2), (256, 1), (8, 192), (4, 8)])
def test_a_gaussian_has_a_ratio_of_1_and_raises_no_alarm(shape):
    health = latent_health(noise(*shape))
    if math.prod(shape[:-1]) >= 128 and shape[-1] > 1:
        assert health.floor_ratio == pytest.approx(1, abs=0.2)
    assert health.alarm is None


@pytest.mark.parametrize("used", [2, 5, 16])
def test_effective_rank_counts_the_dimensions_that_are_used(used):
    """Of a flat spectrum it is the number of its entries (Roy and Vetterli, 2007)."""
    # The first columns after a constant one of an orthogonal matrix: of equal length, and of mean 0.
    basis = torch.linalg.qr(torch.cat([torch.ones(128, 1), noise(128, used)], 1)).Q[:, 1:]
    latent = torch.cat([basis, torch.zeros(128, 16 - used)], 1)
    assert latent_health(latent).effective_rank == pytest.approx(used, rel=1e-3)


@pytest.mark.parametrize("samples", [8, 128])
@pytest.mark.parametrize("place", [0.0, 1.0])
def test_collapse_to_a_point_raises_the_alarm(samples, place):
    health = latent_health(torch.full((2, samples, 16), place) + 1e-3 * noise(2, samples, 16))
    assert "close to collapse" in health.alarm
    assert health.floor_ratio > 0.35 * samples


def test_low_rank_raises_the_alarm():
    """All dimensions are equal: along some directions the latents are Gaussian, and their rank is 1."""
    health = latent_health(noise(256, 1).expand(256, 32) / 32**0.5)
    assert health.effective_rank == pytest.approx(1, abs=0.01) and health.alarm is not None


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_latents_that_are_not_finite_raise_the_alarm(value):
    latent = noise(32, 8)
    latent[3, 3] = value
    assert "not finite" in latent_health(latent).alarm


def test_the_regularizer_is_not_modified():
    for training in (True, False):
        sigreg = SIGReg(16, unit="batch_time").train(training)
        health = latent_health(noise(4, 32, 8).requires_grad_(), sigreg)
        assert health.samples == 128
        assert sigreg.training == training
        assert sigreg.generator_state.tolist() == [0, 0]
