"""Claims about SIGReg: it is the Epps-Pulley statistic, cheaper; golden values at N(0, I) and at collapse."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_ficreg import SIGReg

# Both expectations are Gaussian integrals over [-3, 3]: of (1 - exp(-t^2)) exp(-t^2 / 2), the variance of the empirical
# characteristic function, and of (1 - exp(-t^2 / 2))^2 exp(-t^2 / 2).
ROOT = math.sqrt(2 * math.pi)
ON_GAUSSIAN = ROOT * math.erf(3 / 2**0.5) - ROOT / 3**0.5 * math.erf(3 * 1.5**0.5)
AT_COLLAPSE = (
    ROOT * math.erf(3 / 2**0.5) - 2 * math.sqrt(math.pi) * math.erf(3) + ROOT / 3**0.5 * math.erf(3 * 1.5**0.5)
)


def textbook(latent: torch.Tensor, num_directions: int) -> torch.Tensor:
    """B times the integral, one sine and one cosine per knot; takes the directions SIGReg would draw."""
    directions = torch.randn(latent.shape[-1], num_directions).to(latent)  # [D, M]
    projected = latent @ (directions / directions.norm(dim=0))  # [T, B, M]
    knots = torch.linspace(0, 3, 17).to(latent)
    angle = projected.unsqueeze(-1) * knots  # [T, B, M, 17]
    gaussian = torch.exp(-knots.square() / 2)
    error = (angle.cos().mean(-3) - gaussian).square() + angle.sin().mean(-3).square()  # [T, M, 17]
    return latent.shape[-2] * 2 * torch.trapezoid(error * gaussian, knots).mean()


def seeded(function, latent, *args):
    torch.manual_seed(1)
    latent = latent.detach().requires_grad_()
    value = function(latent, *args)
    return value, torch.autograd.grad(value, latent)[0]


@pytest.mark.parametrize(("batch", "num_directions"), [(32, 1024), (128, 1024), (1024, 256), (4096, 128)])
def test_it_is_1_05_on_a_gaussian_at_any_batch_size(batch, num_directions):
    torch.manual_seed(0)
    assert ON_GAUSSIAN == pytest.approx(1.05, abs=0.005)
    assert SIGReg(num_directions)(torch.randn(4, batch, 64)).item() == pytest.approx(ON_GAUSSIAN, abs=0.1)


@pytest.mark.parametrize("batch", [2, 128])
def test_it_is_0_402_per_row_at_collapse(batch):
    assert AT_COLLAPSE == pytest.approx(0.402, abs=5e-4)
    assert SIGReg(8)(torch.zeros(batch, 5)).item() == pytest.approx(AT_COLLAPSE * batch, rel=2e-3)


@pytest.mark.parametrize("shape", [(1, 4, 3), (3, 32, 6), (2, 128, 16)])
@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_it_equals_the_textbook_formulation_in_value_and_gradient(shape, scale):
    """Angle addition and Horner's rule lose less than 1e-5 against sines and cosines in float64."""
    latent = scale * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    value, gradient = seeded(SIGReg(32), latent)
    expected, expected_gradient = seeded(textbook, latent.double(), 32)
    assert value.item() == pytest.approx(expected.item(), rel=1e-5)
    assert (gradient - expected_gradient).norm() <= 1e-5 * expected_gradient.norm()


def test_the_settings_are_those_of_the_integral():
    """More directions, knots and a longer interval: the statistic of one row at z is a known integral too."""
    # For B = 1 point z doubled, |phi - g|^2 = 1 - 2 g cos(tz) + g^2; D = 1 leaves the direction's sign only.
    z = torch.full((2, 1), 0.7)
    expected = 2 * ROOT * (1 - 2 / 2**0.5 * math.exp(-(0.7**2) / 4) + 1 / 3**0.5)
    assert SIGReg(1, num_knots=65, max_knot=8.0)(z).item() == pytest.approx(expected, rel=1e-4)


def test_the_order_of_the_batch_does_not_matter():
    latent = torch.randn(2, 64, 8)
    value, gradient = seeded(SIGReg(16), latent)
    order = torch.randperm(64)
    shuffled, shuffled_gradient = seeded(SIGReg(16), latent[:, order])
    torch.testing.assert_close(shuffled, value)
    torch.testing.assert_close(shuffled_gradient, gradient[:, order], rtol=1e-4, atol=1e-6)


def test_time_steps_are_judged_apart_and_averaged():
    latent = torch.randn(3, 16, 4)
    single = [seeded(SIGReg(16), row)[0] for row in latent]
    torch.testing.assert_close(seeded(SIGReg(16), latent)[0], torch.stack(single).mean())


def test_directions_are_drawn_anew_at_every_call():
    sigreg, latent = SIGReg(2), torch.randn(8, 4)
    assert sigreg(latent) != sigreg(latent)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_computes_in_float32_inside_autocast(dtype):
    latent = torch.randn(2, 16, 4).to(dtype)
    expected, gradient = seeded(SIGReg(16), latent.float())
    torch.manual_seed(1)
    latent.requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        value = SIGReg(16)(latent)
    assert value.dtype == torch.float32
    assert value.equal(expected)
    assert torch.autograd.grad(value, latent)[0].equal(gradient.to(dtype))


def test_it_pulls_a_collapsed_batch_apart():
    torch.manual_seed(0)
    latent = (0.01 * torch.randn(64, 2)).requires_grad_()
    optimizer, sigreg = torch.optim.Adam([latent], 0.05), SIGReg(16)
    for _ in range(200):
        optimizer.zero_grad()
        sigreg(latent).backward()
        optimizer.step()
    assert latent.mean(0).abs().max() < 0.15
    torch.testing.assert_close(latent.T.cov().detach(), torch.eye(2), rtol=0, atol=0.25)


def test_it_offers_no_second_derivative_rather_than_a_wrong_one():
    latent = torch.randn(8, 3, requires_grad=True)
    (gradient,) = torch.autograd.grad(SIGReg(4)(latent), latent, create_graph=True)
    assert not gradient.requires_grad


def test_it_holds_no_state():
    assert not SIGReg().state_dict()


@pytest.mark.parametrize("shape", [(4,), (1, 4), (2, 1, 4), (2, 2, 2, 4)])
def test_latents_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r"\[T, B, D\] or \[B, D\] with B >= 2, got"):
        SIGReg(4)(torch.zeros(shape))


@pytest.mark.parametrize("wrong", [{"num_directions": 0}, {"num_knots": 1}, {"max_knot": 0.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="num_directions >= 1, num_knots >= 2 and max_knot > 0"):
        SIGReg(**wrong)
