"""Claims about SIGReg: the Epps-Pulley statistic, golden values at N(0, I) and at collapse, masks, random directions."""

from __future__ import annotations

import math

import pytest
import torch
from _losses import noise

from torchrl_ficreg import SIGReg
from torchrl_ficreg.objectives.sigreg import standard_normal

# Both expectations are Gaussian integrals over [-3, 3]: of (1 - exp(-t^2)) exp(-t^2 / 2), the variance of the empirical
# characteristic function, and of (1 - exp(-t^2 / 2))^2 exp(-t^2 / 2).
ROOT = math.sqrt(2 * math.pi)
ON_GAUSSIAN = ROOT * math.erf(3 / 2**0.5) - ROOT / 3**0.5 * math.erf(3 * 1.5**0.5)
AT_COLLAPSE = ROOT * math.erf(3 / 2**0.5) - 2 * math.sqrt(math.pi) * math.erf(3) + ROOT / 3**0.5 * math.erf(3 * 1.5**0.5)


def textbook(latent: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """B times the integral, one sine and one cosine per knot."""
    projected = latent @ directions.to(latent)  # [T, B, M]
    knots = torch.linspace(0, 3, 17).to(latent)
    angle = projected.unsqueeze(-1) * knots  # [T, B, M, 17]
    gaussian = torch.exp(-knots.square() / 2)
    error = (angle.cos().mean(-3) - gaussian).square() + angle.sin().mean(-3).square()  # [T, M, 17]
    return latent.shape[-2] * 2 * torch.trapezoid(error * gaussian, knots).mean()


def with_gradient(function, latent, *args):
    latent = latent.detach().requires_grad_()
    value = function(latent, *args)
    return value.detach(), torch.autograd.grad(value, latent)[0]


# The numbers


@pytest.mark.parametrize("batch", [32, 128, 1024])
def test_it_is_1_05_on_a_gaussian_at_any_batch_size(batch):
    """1.05 ± 0.1, with enough dimensions for the directions to be nearly independent."""
    assert ON_GAUSSIAN == pytest.approx(1.05, abs=0.005)
    value = SIGReg(512)(noise(4, batch, 192))
    assert value.item() == pytest.approx(ON_GAUSSIAN, abs=0.1)


@pytest.mark.parametrize("batch", [2, 128])
def test_it_is_0_402_per_row_at_collapse(batch):
    assert AT_COLLAPSE == pytest.approx(0.402, abs=5e-4)
    assert SIGReg(8)(torch.zeros(batch, 5)).item() == pytest.approx(AT_COLLAPSE * batch, rel=2e-3)


@pytest.mark.parametrize("shape", [(1, 4, 3), (3, 32, 6), (2, 128, 16)])
@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_it_equals_the_textbook_formulation_in_value_and_gradient(shape, scale):
    """Powers and Horner's rule lose less than 1e-5 against sines and cosines in float64."""
    latent, sigreg = scale * noise(*shape), SIGReg(32).eval()
    directions = sigreg._draw(shape[-1])  # [D, M], those of every call in eval mode
    expected, expected_gradient = with_gradient(textbook, latent.double(), directions)
    value, gradient = with_gradient(sigreg, latent)
    assert value.item() == pytest.approx(expected.item(), rel=1e-5)
    assert (gradient - expected_gradient).norm() <= 1e-5 * expected_gradient.norm()


def test_the_settings_are_those_of_the_integral():
    """More knots and a longer interval: the statistic of one row at z is a known integral too."""
    # For B = 1 point z doubled, |phi - g|^2 = 1 - 2 g cos(tz) + g^2; D = 1 leaves the direction's sign only.
    z = torch.full((2, 1), 0.7)
    expected = 2 * ROOT * (1 - 2 / 2**0.5 * math.exp(-(0.7**2) / 4) + 1 / 3**0.5)
    assert SIGReg(1, num_knots=65, max_knot=8.0)(z).item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("masked", [True, False])
def test_torch_func_gives_the_same_values_and_gradients(masked):
    """``grad``, ``vmap`` and gradients of each of several batches."""
    sigreg, latent = SIGReg(num_directions=32).eval(), torch.randn(2, 3, 8, 5, dtype=torch.float64, requires_grad=True)
    mask = torch.rand(2, 3, 8) > 0.3 if masked else None
    args = (latent,) if mask is None else (latent, mask)
    values = torch.stack([sigreg(*batch) for batch in zip(*args)])
    (gradient,) = torch.autograd.grad(values.sum(), latent)
    torch.testing.assert_close(torch.vmap(sigreg)(*args), values)
    torch.testing.assert_close(torch.compile(torch.vmap(sigreg), backend="eager", fullgraph=True)(*args), values)
    torch.testing.assert_close(torch.vmap(torch.func.grad(sigreg))(*args), gradient)
    torch.testing.assert_close(torch.func.grad(lambda *x: torch.vmap(sigreg)(*x).sum())(*args), gradient)


def test_it_pulls_a_collapsed_batch_apart():
    latent = (0.01 * noise(64, 2)).requires_grad_()
    optimizer, sigreg = torch.optim.Adam([latent], 0.05), SIGReg(16)
    for _ in range(200):
        optimizer.zero_grad()
        sigreg(latent).backward()
        optimizer.step()
    assert latent.mean(0).abs().max() < 0.15
    torch.testing.assert_close(latent.T.cov().detach(), torch.eye(2), rtol=0, atol=0.25)


def test_it_has_no_second_derivative():
    latent = noise(8, 3).requires_grad_()
    (gradient,) = torch.autograd.grad(SIGReg(4)(latent), latent, create_graph=True)
    assert not gradient.requires_grad


# What it does not depend on


def test_the_order_of_the_batch_does_not_matter():
    """In exact arithmetic; in float64, to 1e-12."""
    latent, order = noise(2, 64, 8, dtype=torch.float64), torch.randperm(64, generator=torch.Generator().manual_seed(1))
    value, gradient = with_gradient(SIGReg(16), latent)
    shuffled, shuffled_gradient = with_gradient(SIGReg(16), latent[:, order])
    torch.testing.assert_close(shuffled, value, rtol=1e-12, atol=0)
    torch.testing.assert_close(shuffled_gradient, gradient[:, order], rtol=0, atol=1e-13)


def test_time_steps_are_averaged_and_batch_time_takes_all_latents_together():
    latent = noise(3, 16, 4)
    by_time, together = SIGReg(16)(latent), SIGReg(16, unit="batch_time")(latent)
    torch.testing.assert_close(by_time, torch.stack([SIGReg(16)(row) for row in latent]).mean())
    torch.testing.assert_close(together, SIGReg(16)(latent.flatten(0, 1)))
    assert not together.isclose(by_time)


# Masks


@pytest.mark.parametrize("unit", ["time", "batch_time"])
@pytest.mark.parametrize("poison", [math.nan, math.inf, 1e30])
def test_masked_latents_contribute_nothing_whatever_they_hold(unit, poison):
    """The statistic of the selected rows, and no gradient for the others."""
    latent, mask = noise(2, 16, 4), noise(2, 16, seed=1) > -0.3
    sigreg = SIGReg(16, unit=unit).eval()
    rows = [row[kept] for row, kept in zip(latent, mask)] if unit == "time" else [latent[mask]]
    value, gradient = with_gradient(sigreg, torch.where(mask.unsqueeze(-1), latent, poison), mask)
    expected = [with_gradient(sigreg, row) for row in rows]
    torch.testing.assert_close(value, torch.stack([each for each, _ in expected]).mean())
    torch.testing.assert_close(gradient[mask], torch.cat([grad / len(rows) for _, grad in expected]))
    assert (gradient[~mask] == 0).all()


def test_a_mask_of_zeros_gives_zero():
    value, gradient = with_gradient(SIGReg(16), noise(2, 8, 4), torch.zeros(2, 8, dtype=torch.bool))
    assert value == 0 and (gradient == 0).all()


# Directions and their state


def test_directions_are_drawn_anew_at_every_call_in_train_mode_only():
    sigreg, latent = SIGReg(2), noise(8, 4)
    first, second = sigreg(latent), sigreg(latent)
    assert first != second
    sigreg.eval()
    state = sigreg.generator_state.clone()
    third = sigreg(latent)
    assert third.equal(sigreg(latent))
    assert sigreg.generator_state.equal(state)
    assert sigreg.train()(latent).equal(third)  # used in eval mode, drawn now
    assert sigreg.generator_state.tolist() == [0, 3]


def test_the_state_is_saved():
    one, other, latent = SIGReg(4, seed=7), SIGReg(4), noise(8, 4)
    one(latent)
    assert list(one.state_dict()) == ["generator_state"]
    other.load_state_dict(one.state_dict())
    assert other.generator_state.tolist() == [7, 1]
    assert [one(latent).item() for _ in range(3)] == [other(latent).item() for _ in range(3)]


def test_seeds_differ_and_the_global_random_state_is_neither_read_nor_changed():
    latent = noise(8, 4)
    torch.manual_seed(0)
    before = torch.get_rng_state()
    values = [SIGReg(4, seed=seed)(latent).item() for seed in (0, 1, 2, -1, 2**40)]
    assert len(set(values)) == 5
    assert torch.get_rng_state().equal(before)
    torch.manual_seed(1)
    assert SIGReg(4)(latent).item() == values[0]


@pytest.mark.parametrize("dim", [1, 2, 192])
def test_directions_are_unit_vectors_even_in_few_dimensions(dim):
    torch.testing.assert_close(SIGReg(1000)._draw(dim).norm(dim=0), torch.ones(1000))


def test_no_radius_is_zero_or_infinite():
    """The extreme words of the generator: 0 / 0 in one or two dimensions would end a run after thousands of steps."""
    uniform = (torch.tensor([0, 2**23 - 1]).float() + 0.5) / 2**23
    radius = (-2 * uniform.log()).sqrt()
    assert (radius > 0).all()
    assert radius.isfinite().all()
    draws = torch.cat([standard_normal(torch.tensor([0, draw]), 2**20) for draw in range(4)])
    pairs = draws.view(4, 2, -1)  # the two halves of a draw share radii
    assert pairs.square().sum(1).min() > 0
    assert draws.abs().max() < math.sqrt(2 * 24 * math.log(2))


def test_the_numbers_are_standard_normal():
    """Moments of 2^20 numbers within 5 standard errors; cumulative distribution against erf."""
    draws = standard_normal(torch.tensor([3, 5]), 2**20).double()
    error = 5 / 2**10
    for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96), (6, 15, 10170)):
        assert draws.pow(power).mean().item() == pytest.approx(moment, abs=error * variance**0.5)
    for point in (-3.0, -1.0, 0.0, 0.5, 2.0):
        expected = 0.5 * (1 + math.erf(point / 2**0.5))
        assert (draws < point).double().mean().item() == pytest.approx(expected, abs=error / 2)


def test_neighbouring_positions_draws_and_seeds_are_uncorrelated():
    def draw(seed, number):
        return standard_normal(torch.tensor([seed, number]), 2**18).double()

    base = draw(0, 0)
    others = {"draw": draw(0, 1), "seed": draw(1, 0), "swap": draw(1, 1), "far": draw(0, 10**6)}
    others |= {f"shift {by}": base.roll(by) for by in (1, 2, 192, 1024, 2**17)}
    for name, other in others.items():
        assert abs((base * other).mean().item()) < 5 / 2**9, name
        assert abs((base.square() * other.square()).mean().item() - 1) < 5 * 8**0.5 / 2**9, name
    assert not draw(1, 0).equal(draw(0, 1))


def test_numbers_depend_on_the_state_only_which_is_not_modified():
    state = torch.tensor([3, 5])
    assert standard_normal(state, 10).equal(standard_normal(state, 10))
    assert len(standard_normal(state, 7)) == 7 and state.tolist() == [3, 5]


# Precision and compilation


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_computes_in_float32_inside_autocast(dtype):
    latent = noise(2, 16, 4).to(dtype).requires_grad_()
    expected, gradient = with_gradient(SIGReg(16), latent.float())
    with torch.autocast("cpu", torch.bfloat16):
        value = SIGReg(16)(latent)
    assert value.dtype == torch.float32
    assert value.equal(expected)
    assert torch.autograd.grad(value, latent)[0].equal(gradient.to(dtype))


def test_a_module_in_half_precision_draws_the_same_directions():
    latent = noise(2, 16, 4)
    half = SIGReg(16).to(torch.bfloat16)
    assert half.generator_state.dtype == torch.int64
    assert half(latent).equal(SIGReg(16)(latent))
    assert half(latent.bfloat16()).isfinite()


def test_with_a_mask_it_compiles_into_one_graph_that_draws_the_same_directions():
    """Without one, see the compiled losses."""
    latent, mask = noise(2, 16, 4), noise(2, 16, seed=1) > 0
    eager, graph = SIGReg(16), SIGReg(16)
    torch._dynamo.reset()
    compiled = torch.compile(graph, fullgraph=True, backend="aot_eager")
    for _ in range(3):
        expected, found = (with_gradient(each, latent, mask) for each in (eager, compiled))
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)
    assert graph.generator_state.equal(eager.generator_state)


# Mistakes


@pytest.mark.parametrize(
    ("settings", "inputs", "message"),
    [
        *(({}, [torch.zeros(s)], r"\[T, B, D\] or \[B, D\] with B >= 2, got") for s in [(4,), (1, 4), (2, 1, 4), (2, 2, 2, 4)]),
        *(
            ({}, [torch.zeros(2, 8, 3), mask], r"the mask must be \[2, 8\] bool, got")
            for mask in (torch.ones(2, 8), torch.ones(8) > 0, torch.ones(2, 8, 1) > 0)
        ),
        *(
            (wrong, [], "num_directions >= 1, num_knots >= 2 and max_knot > 0")
            for wrong in ({"num_directions": 0}, {"num_knots": 1}, *({"max_knot": x} for x in (0.0, math.nan, math.inf)))
        ),
        ({"unit": "step"}, [], "unknown unit 'step'"),
    ],
)
def test_wrong_settings_latents_and_masks_are_refused(settings, inputs, message):
    with pytest.raises(ValueError, match=message):
        SIGReg(**settings)(*inputs)
