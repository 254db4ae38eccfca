"""Claims about what iCEM and MPPI do differently: populations, elites carried over, coloured noise, and weights."""

from __future__ import annotations

import pytest
import torch
from making import make_planner

from torchrl_ficreg import GoalDistance
from torchrl_ficreg.planners.base import Problem
from torchrl_ficreg.planners.sampling import coloured

SIZES = {"num_candidates": 40, "num_elites": 8, "iterations": 5}


@pytest.fixture
def goal():
    return torch.tensor([[2.0, -1.0]])


def search(name, world, goal, distance=None, **settings):
    """A plan from the origin, and what was evaluated: actions and costs of each iteration, then of the plan."""
    evaluated = []

    def cost(predicted, goal, action):
        cost = (distance or GoalDistance())(predicted, goal)
        evaluated.append((action[0].clone(), cost[0].clone()))  # [K, H, F * A] and [K]
        return cost

    planner = make_planner(name, world, cost=cost, **{**SIZES, **settings})
    return planner.plan(torch.zeros(1, 2), goal)["plan"][0], evaluated


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"decay": 1.0}, [40, 40, 40, 40, 40]),
        ({"decay": 1.25}, [40, 32, 25, 20, 16]),
        ({"decay": 2.0}, [40, 20, 16, 16, 16]),  # never fewer than twice the elites
        ({"decay": 2.0, "num_elites": 30}, [40, 40, 40, 40, 40]),  # nor more than the first time
    ],
)
def test_the_population_shrinks_down_to_twice_the_elites(linear_world, goal, settings, expected):
    _, evaluated = search("icem", linear_world(), goal, **settings)
    assert [len(action) for action, _ in evaluated] == [*expected, 1]


@pytest.mark.parametrize(("share", "kept"), [(0.0, 0), (0.25, 2), (1.0, 8)])
def test_the_best_elites_are_carried_over(linear_world, goal, share, kept):
    """Unchanged, after the mean; so the best candidate never gets worse."""
    _, evaluated = search("icem", linear_world(), goal, kept_elites=share)
    for (before, cost), (after, _) in zip(evaluated, evaluated[1:-1]):
        best = before[cost.topk(8, largest=False).indices]
        assert after[1 : 1 + kept].equal(best[:kept]) and not after[1 + kept].equal(best[kept % 8])
    if kept:
        lowest = torch.stack([cost.min() for _, cost in evaluated])
        assert (lowest.diff() <= 0).all()


def test_all_elites_may_be_kept_where_they_are_all_there_is(linear_world, goal):
    """Candidate 0 is the mean all the same."""
    plan, evaluated = search("icem", linear_world(), goal, num_candidates=6, num_elites=6, kept_elites=1.0, momentum=0.0)
    for (before, _), (after, _) in zip(evaluated, evaluated[1:-1]):
        torch.testing.assert_close(after[0], before.mean(0))
    assert plan.isfinite().all()


def test_the_plan_is_the_best_candidate_of_the_last_iteration(linear_world, goal):
    plan, evaluated = search("icem", linear_world(), goal)
    candidates, cost = evaluated[-2]
    assert plan.equal(candidates[cost.argmin()])


def test_momentum_keeps_part_of_the_old_mean(linear_world, goal):
    _, evaluated = search("icem", linear_world(), goal, momentum=0.25)
    for (before, cost), (after, _) in zip(evaluated, evaluated[1:-1]):
        elites = before[cost.topk(8, largest=False).indices].mean(0)
        torch.testing.assert_close(after[0], 0.75 * elites + 0.25 * before[0])


@pytest.mark.parametrize("length", [2, 7, 20])
@pytest.mark.parametrize("beta", [0.5, 1.0, 2.0, 4.0])
def test_coloured_noise_has_unit_variance_at_every_time_and_the_stated_spectrum(beta, length):
    white = torch.randn(50_000, length, generator=torch.Generator().manual_seed(0))
    noise = coloured(white, beta, dim=1)
    torch.testing.assert_close(noise.var(0), torch.ones(length), rtol=0.03, atol=0)
    power = torch.fft.rfft(noise, dim=1).abs().square().mean(0)  # at frequency 0, 1 / length, ...
    frequency = torch.arange(len(power)).clamp_min(1.0)  # the constant part has the power of the lowest
    torch.testing.assert_close(power / power[1], frequency**-beta, rtol=0.05, atol=1e-5)


@pytest.mark.parametrize("dim", [0, 1, 2, -1, -2, -3])
def test_time_may_be_any_dimension_and_a_beta_of_zero_or_a_single_time_leave_it_white(dim):
    white = torch.randn(4, 5, 6)
    moved = coloured(white.movedim(dim, -1), 2.0, dim=-1).movedim(-1, dim)
    torch.testing.assert_close(coloured(white, 2.0, dim=dim), moved)
    single = white.narrow(dim, 0, 1)
    assert coloured(white, 0.0, dim=dim).equal(white) and coloured(single, 2.0, dim=dim).equal(single)


def test_noise_runs_on_across_the_borders_of_blocks(linear_world):
    """Successive raw actions correlate equally inside a block and between two; the two dimensions do not correlate."""
    many = {"num_candidates": 8000, "iterations": 1, "bounds": "none"}
    _, evaluated = search("icem", linear_world(3), torch.zeros(1, 2), **many)
    raw = evaluated[0][0][1:].unflatten(-1, (3, 2)).flatten(1, 2)  # [K - 1, H * F, A]
    correlation = (raw[:, 1:] * raw[:, :-1]).mean(0)  # [H * F - 1, A], borders after 2 and 5
    torch.testing.assert_close(correlation, correlation.mean().expand_as(correlation), rtol=0, atol=0.05)
    assert correlation.mean() > 0.5 and (raw[..., 0] * raw[..., 1]).mean().abs() < 0.05
    torch.testing.assert_close(raw.var(0), torch.ones(9, 2), rtol=0.06, atol=0)


@pytest.mark.parametrize("temperature", [1e-6, 0.7, 1e6])
def test_its_weights_are_a_softmax_over_the_standardised_costs_of_the_elites(linear_world, goal, temperature):
    """Near zero the best candidate is taken, at a high temperature all elites count the same."""
    plan, evaluated = search("mppi", linear_world(), goal, iterations=1, temperature=temperature)
    candidates, cost = evaluated[0]
    lowest, rows = cost.topk(8, largest=False)
    weight = torch.softmax(-lowest / (temperature * lowest.std()), 0)
    torch.testing.assert_close(plan, (weight @ candidates[rows].flatten(1)).view_as(plan))


@pytest.mark.parametrize("temperature", [0.5, 1e-12])
def test_elites_that_cost_the_same_count_the_same(linear_world, temperature):
    """As on a corner of the bounds: no division of zero by zero."""
    world, goal = linear_world(), torch.zeros(1, 2)
    plan, evaluated = search("mppi", world, goal, lambda z, goal: torch.ones(z.shape[:2]), temperature=temperature)
    candidates, cost = evaluated[-2]
    torch.testing.assert_close(plan, candidates[cost.topk(8, largest=False).indices].mean(0))


def test_its_std_never_falls_below_the_smallest(linear_world, goal):
    """So candidates differ to the end."""
    settings = {"iterations": 15, "min_std": 0.2, "bounds": "none", "num_candidates": 400}
    _, evaluated = search("mppi", linear_world(), goal, **settings)
    assert evaluated[-2][0][1:].std(0).min() > 0.18


@pytest.mark.parametrize("name", ["cem", "icem", "mppi", "shooting"])
def test_the_order_of_the_candidates_does_not_matter(linear_world, goal, monkeypatch, name):
    expected, _ = search(name, linear_world(), goal, iterations=1)
    draw = Problem.noise

    def shuffled(problem, count):
        noise = draw(problem, count)
        order = 1 + torch.randperm(count - 1)  # candidate 0 is the mean
        return torch.cat([noise[:, :1], noise[:, order]], dim=1)

    monkeypatch.setattr(Problem, "noise", shuffled)
    torch.testing.assert_close(search(name, linear_world(), goal, iterations=1)[0], expected)
