"""Claims about the term functions and their modules: formulas, golden numbers, gradients, dtypes, checks."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_ficreg import CovariancePenalty, TemporalStraightness, VarianceHinge
from torchrl_ficreg.objectives.terms import (
    gaussian_nll,
    hinge_std,
    off_diagonal_covariance,
    squared_error,
    straightness,
)


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_the_likelihood_is_that_of_a_normal_distribution():
    mean, log_var, target = noise(5, 3), noise(5, 3, seed=1), noise(5, 3, seed=2)
    density = torch.distributions.Normal(mean, (log_var / 2).exp()).log_prob(target)
    torch.testing.assert_close(gaussian_nll(mean, log_var, target), -density - 0.5 * math.log(2 * math.pi))


def test_the_variance_hinge_is_vicregs():
    latent = noise(2, 10, 3) * torch.tensor([0.1, 0.5, 5.0])
    expected = torch.relu(1.2 - torch.sqrt(latent.var(dim=1) + 1e-4))  # arXiv 2105.04906, equation 1
    torch.testing.assert_close(hinge_std(latent, 1, 1.2), expected)
    torch.testing.assert_close(VarianceHinge(1.2)(latent), expected.mean())
    assert VarianceHinge()(5 * noise(64, 3)) == 0


def test_the_covariance_penalty_is_vicregs():
    latent = noise(2, 10, 3)
    covariances = [batch.T.cov() for batch in latent]
    expected = torch.stack([(each - torch.diag(each.diagonal())).square().sum() / 3 for each in covariances])
    torch.testing.assert_close(off_diagonal_covariance(latent), expected)  # arXiv 2105.04906, equations 3 and 4
    torch.testing.assert_close(CovariancePenalty()(latent), expected.mean())
    assert CovariancePenalty()(torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])) == 0


@pytest.mark.parametrize(("angle", "expected"), [(0.0, 1.0), (math.pi / 3, 0.5), (math.pi / 2, 0.0), (math.pi, -1.0)])
def test_straightness_is_the_cosine_of_the_turn(angle, expected):
    path = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1 + 2 * math.cos(angle), 2 * math.sin(angle)]])
    assert straightness(path).item() == pytest.approx(expected, abs=1e-6)
    assert TemporalStraightness()(path + 7).item() == pytest.approx(expected, abs=1e-6)


def test_straightness_is_differentiable_and_zero_at_a_step_of_length_zero():
    assert straightness(torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])).item() == 0
    assert torch.autograd.gradcheck(straightness, noise(2, 5, 3).requires_grad_())


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_terms_are_computed_in_at_least_float32(dtype):
    x, y = noise(2, 5, 3).to(dtype), noise(2, 5, 3, seed=1).to(dtype)
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    terms = squared_error(x, y), gaussian_nll(x, y, y), hinge_std(x, -2), off_diagonal_covariance(x), straightness(x)
    assert {term.dtype for term in terms} == {wide}


def test_nothing_is_broadcast():
    with pytest.raises(ValueError, match=r"got \[4, 1\] for \[4, 6\]: check the widths"):
        squared_error(torch.zeros(4, 1), torch.zeros(4, 6))


@pytest.mark.parametrize(
    ("module", "shapes", "message"),
    [
        (VarianceHinge(), [(8,), (1, 8), (3, 1, 8)], r"\[..., B, D\] with B >= 2"),
        (CovariancePenalty(), [(8,), (1, 8), (3, 1, 8)], r"\[..., B, D\] with B >= 2"),
        (TemporalStraightness(), [(8,), (2, 8), (4, 2, 8)], "T >= 3"),
    ],
)
def test_statistics_of_one_sample_and_straightness_of_two_points_are_refused(module, shapes, message):
    for shape in shapes:
        with pytest.raises(ValueError, match=message):
            module(torch.zeros(shape))


@pytest.mark.parametrize("margin", [0.0, -1.0, math.nan])
def test_a_margin_that_is_not_positive_is_refused(margin):
    with pytest.raises(ValueError, match="margin must be positive"):
        VarianceHinge(margin)
