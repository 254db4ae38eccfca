"""Claims about what iCEM and MPPI do differently: populations, elites that come back, coloured noise, and weights."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_ficreg import GoalDistance, LatentICEMPlanner, LatentMPPIPlanner, MPPIConfig
from torchrl_ficreg.planners import SEARCHES
from torchrl_ficreg.planners.problem import Problem
from torchrl_ficreg.planners.sampling import coloured

pytestmark = pytest.mark.usefixtures("fast_bf16")

UNIT = ([-1.0, -1.0], [1.0, 1.0])
SIZES = {"num_candidates": 40, "num_elites": 8, "iterations": 5, "horizon": 3, "receding_horizon": 1}
SIZES |= {"precision": "fp32"}


class Noted(nn.Module):
    """The distance from the goal, and every population it was asked about with its costs."""

    def __init__(self, cost=None):
        super().__init__()
        self.cost, self.asked = cost or GoalDistance(), []

    def forward(self, predicted, goal, action):
        cost = self.cost(predicted, goal)
        self.asked.append((action[0].clone(), cost[0].clone()))  # [K, H, F * A] and [K]
        return cost


@pytest.fixture
def goal():
    return torch.tensor([[2.0, -1.0]])


def search(kind, world, goal, **settings):
    """A plan from the origin, and what was asked on the way: a population of each iteration, then the plan."""
    noted = Noted()
    config = kind.config_class(**{**SIZES, **settings})
    result = kind(world, config, action_bounds=UNIT, cost=noted).plan(torch.zeros(1, 2), goal)
    return result["plan"][0], noted.asked


# iCEM


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
    _, asked = search(LatentICEMPlanner, linear_world(), goal, **settings)
    assert [len(action) for action, _ in asked] == [*expected, 1]


@pytest.mark.parametrize(("share", "kept"), [(0.0, 0), (0.25, 2), (1.0, 8)])
def test_the_best_elites_compete_again(linear_world, goal, share, kept):
    """After the mean, as they were; so the best candidate never gets worse."""
    _, asked = search(LatentICEMPlanner, linear_world(), goal, kept_elites=share)
    for (before, cost), (after, _) in zip(asked, asked[1:-1]):
        best = before[cost.topk(8, largest=False).indices]
        assert after[1 : 1 + kept].equal(best[:kept])
        assert not after[1 + kept].equal(best[kept % 8])
    if kept:
        lowest = torch.stack([cost.min() for _, cost in asked])
        assert (lowest.diff() <= 0).all()


def test_all_elites_may_be_kept_where_they_are_all_there_is(linear_world, goal):
    """Candidate 0 is the mean all the same."""
    plan, asked = search(
        LatentICEMPlanner, linear_world(), goal, num_candidates=6, num_elites=6, kept_elites=1.0, momentum=0.0
    )
    for (before, _), (after, _) in zip(asked, asked[1:-1]):
        torch.testing.assert_close(after[0], before.mean(0))
    assert plan.isfinite().all()


def test_the_plan_is_the_best_candidate_of_the_last_iteration(linear_world, goal):
    plan, asked = search(LatentICEMPlanner, linear_world(), goal)
    candidates, cost = asked[-2]
    assert plan.equal(candidates[cost.argmin()])


def test_momentum_keeps_a_share_of_the_old_mean(linear_world, goal):
    _, asked = search(LatentICEMPlanner, linear_world(), goal, momentum=0.25)
    for (before, cost), (after, _) in zip(asked, asked[1:-1]):
        elites = before[cost.topk(8, largest=False).indices].mean(0)
        torch.testing.assert_close(after[0], 0.75 * elites + 0.25 * before[0])


# Coloured noise


@pytest.mark.parametrize("length", [2, 7, 20])
@pytest.mark.parametrize("beta", [0.5, 1.0, 2.0, 4.0])
def test_coloured_noise_has_unit_variance_at_every_time_and_the_stated_spectrum(beta, length):
    white = torch.randn(50_000, length, generator=torch.Generator().manual_seed(0))
    noise = coloured(white, beta, dim=1)
    torch.testing.assert_close(noise.var(0), torch.ones(length), rtol=0.03, atol=0)
    power = torch.fft.rfft(noise, dim=1).abs().square().mean(0)  # at frequency 0, 1 / length, ...
    frequency = torch.arange(len(power)).clamp_min(1.0)  # the constant part has the power of the lowest
    torch.testing.assert_close(power / power[1], frequency**-beta, rtol=0.05, atol=1e-5)


def test_a_beta_of_zero_and_a_single_time_leave_it_white():
    white = torch.randn(5, 6, 7)
    assert coloured(white, 0.0, dim=1).equal(white)
    assert coloured(white[:, :1], 2.0, dim=1).equal(white[:, :1])


@pytest.mark.parametrize("dim", [0, 1, 2, -1, -2, -3])
def test_time_may_be_any_dimension(dim):
    white = torch.randn(4, 5, 6)
    moved = coloured(white.movedim(dim, -1), 2.0, dim=-1).movedim(-1, dim)
    torch.testing.assert_close(coloured(white, 2.0, dim=dim), moved)


def test_noise_runs_on_across_the_borders_of_blocks(linear_world):
    """Neighbouring raw actions are equally alike inside a block and between two; the two dimensions are strangers."""
    many = {"num_candidates": 8000, "iterations": 1, "bounds": "none"}
    _, asked = search(LatentICEMPlanner, linear_world(3), torch.zeros(1, 2), **many)
    raw = asked[0][0][1:].unflatten(-1, (3, 2)).flatten(1, 2)  # [K - 1, H * F, A]
    alike = (raw[:, 1:] * raw[:, :-1]).mean(0)  # [H * F - 1, A], borders after 2 and 5
    torch.testing.assert_close(alike, alike.mean().expand_as(alike), rtol=0, atol=0.05)
    assert alike.mean() > 0.5
    assert (raw[..., 0] * raw[..., 1]).mean().abs() < 0.05
    torch.testing.assert_close(raw.var(0), torch.ones(9, 2), rtol=0.06, atol=0)


# MPPI


def test_at_a_temperature_near_zero_the_best_candidate_is_taken(linear_world, goal):
    plan, asked = search(LatentMPPIPlanner, linear_world(), goal, temperature=1e-6)
    candidates, cost = asked[-2]
    torch.testing.assert_close(plan, candidates[cost.argmin()])


def test_at_a_high_temperature_all_elites_count_the_same(linear_world, goal):
    plan, asked = search(LatentMPPIPlanner, linear_world(), goal, temperature=1e6)
    candidates, cost = asked[-2]
    torch.testing.assert_close(plan, candidates[cost.topk(8, largest=False).indices].mean(0), rtol=1e-3, atol=1e-4)


def test_its_weights_are_a_softmax_over_the_standardised_costs_of_the_elites(linear_world, goal):
    plan, asked = search(LatentMPPIPlanner, linear_world(), goal, iterations=1, temperature=0.7)
    candidates, cost = asked[0]
    lowest, rows = cost.topk(8, largest=False)
    weight = torch.exp(-lowest / (0.7 * lowest.std()))
    torch.testing.assert_close(plan, (weight / weight.sum() @ candidates[rows].flatten(1)).view_as(plan))


@pytest.mark.parametrize("temperature", [0.5, 1e-12])
def test_elites_that_cost_the_same_count_the_same(linear_world, temperature):
    """As on a corner of the bounds; no division of nothing by nothing."""
    noted = Noted(lambda predicted, goal: torch.ones(predicted.shape[:2]))
    config = MPPIConfig(**SIZES, temperature=temperature)
    plan = LatentMPPIPlanner(linear_world(), config, action_bounds=UNIT, cost=noted).plan(*torch.zeros(2, 1, 2))["plan"]
    candidates, cost = noted.asked[-2]
    torch.testing.assert_close(plan[0], candidates[cost.topk(8, largest=False).indices].mean(0))


def test_its_std_never_falls_below_the_smallest(linear_world, goal):
    """So candidates differ to the end."""
    settings = {"iterations": 15, "min_std": 0.2, "bounds": "none", "num_candidates": 400}
    _, asked = search(LatentMPPIPlanner, linear_world(), goal, **settings)
    assert asked[-2][0][1:].std(0).min() > 0.18


@pytest.mark.parametrize("name", ["cem", "icem", "mppi", "shooting"])
def test_the_order_of_the_candidates_does_not_matter(linear_world, goal, monkeypatch, name):
    kind, world = SEARCHES[name], linear_world()
    expected, _ = search(kind, world, goal, iterations=1)
    draw = Problem.noise

    def shuffled(problem, count):
        noise = draw(problem, count)
        order = 1 + torch.randperm(count - 1)  # candidate 0 is the mean
        return torch.cat([noise[:, :1], noise[:, order]], dim=1)

    monkeypatch.setattr(Problem, "noise", shuffled)
    torch.testing.assert_close(search(kind, world, goal, iterations=1)[0], expected)
