"""Claims about costs: each is its formula, a scale-free sum is independent of units, a cost gets the arguments it names."""

from __future__ import annotations

import functools

import pytest
import torch
from making import make_planner
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import (
    ActionEffort,
    CostSum,
    GoalDistance,
    InverseConsistency,
    InverseDynamicsModel,
    PathDistance,
    StayDistance,
)

FAST = {"num_candidates": 32, "num_elites": 6, "iterations": 5}


@pytest.fixture
def imagined():
    """Predictions [2, 5, 3, 4], goals [2, 4], action blocks [2, 5, 3, 6] and starts [2, 4]."""
    return torch.randn(2, 5, 3, 4), torch.randn(2, 4), torch.randn(2, 5, 3, 6), torch.randn(2, 4)


@pytest.mark.parametrize(
    ("cost", "formula"),
    [
        (GoalDistance(), lambda distance, action: distance[2]),
        (PathDistance(), lambda distance, action: sum(distance) / 3),
        (PathDistance(0.5), lambda distance, action: (distance[0] + 2 * distance[1] + 4 * distance[2]) / 7),
        (ActionEffort(), lambda distance, action: sum(value**2 for value in action.flatten()) / 18),
    ],
    ids=["goal", "path", "discounted path", "effort"],
)
def test_a_cost_is_its_formula(imagined, cost, formula):
    """Of the squared distances after each of three blocks, or of the actions, for every environment and candidate."""
    predicted, goal, action, _ = imagined
    distance = [[[((z - goal[e]) ** 2).sum() for z in predicted[e, k]] for k in range(5)] for e in range(2)]
    expected = [[formula(distance[e][k], action[e, k]).item() for k in range(5)] for e in range(2)]
    torch.testing.assert_close(CostSum([cost], [1.0])(*imagined), torch.tensor(expected))


def test_a_time_to_go_says_from_which_block_on_distances_count(imagined):
    """Due at the horizon, staying is arriving; due at once, it is the whole path. A sum passes the time on."""
    predicted, goal, *rest = imagined
    goal_distance, stay, path = GoalDistance(), StayDistance(), PathDistance()
    last, first = torch.tensor([3, 3]), torch.tensor([1, 1])
    for cost in (goal_distance, stay):
        torch.testing.assert_close(cost(predicted, goal), goal_distance(predicted, goal, last))
        assert torch.equal(cost(predicted, goal), cost(predicted, goal, last))
        mixed = cost(predicted, goal, torch.tensor([2, 1]))
        assert mixed[0].equal(cost(predicted, goal, first + 1)[0]) and mixed[1].equal(cost(predicted, goal, first)[1])
        assert torch.equal(CostSum([cost], [1.0])(predicted, goal, *rest, time_to_go=first), cost(predicted, goal, first))
    torch.testing.assert_close(goal_distance(predicted, goal, first), goal_distance(predicted[:, :, :1], goal))
    torch.testing.assert_close(stay(predicted, goal, first), path(predicted, goal))


@pytest.mark.parametrize("discount", [0.0, 1.5, float("nan")])
@pytest.mark.parametrize("cost", [PathDistance, StayDistance])
def test_a_discount_out_of_range_is_refused(cost, discount):
    with pytest.raises(ValueError, match=r"discount must lie in \(0, 1\]"):
        cost(discount)


@pytest.mark.parametrize(("kind", "history"), [("mlp", 1), ("transformer", 3)])
@pytest.mark.parametrize("blocks", [1, 3, 5])
def test_consistency_is_the_error_of_the_actions_recovered_from_the_last_latents(kind, history, blocks):
    """Step by step, whatever the horizon: the error of step t is that of the window of latents that ends at t."""
    sizes = {"history": history, "heads": 2, "depth": 1} if history > 1 else {}
    inverse_model = InverseDynamicsModel(4, 6, 16, kind=kind, **sizes).eval()
    predicted, goal = torch.randn(2, 5, blocks, 4), torch.randn(2, 4)
    action, start = torch.randn(2, 5, blocks, 6), torch.randn(2, 4)
    before = torch.cat([start[:, None, None].expand(-1, 5, 1, -1), predicted[:, :, :-1]], dim=2)
    errors = []
    for step in range(blocks):
        window = slice(max(0, step - history + 1), step + 1)
        recovered = inverse_model(latent=before[:, :, window], next_latent=predicted[:, :, window])[:, :, -1]
        errors.append((recovered - action[:, :, step]).square())
    expected = torch.stack(errors, dim=2).mean((-1, -2))
    torch.testing.assert_close(InverseConsistency(inverse_model)(predicted, goal, action, start), expected)


class Difference(nn.Module):
    """z' - z, at most one in size: the inverse of z' = z + a on a training distribution of small steps."""

    def forward(self, latent, next_latent):
        return (next_latent - latent).clamp(-1.0, 1.0)


@pytest.fixture
def inverse_model():
    return TensorDictModule(Difference(), [("now", "z"), ("then", "z")], ["recovered"])


def test_actions_that_are_recovered_exactly_cost_nothing(inverse_model):
    """Its keys may be nested."""
    start, action = torch.randn(2, 4), 0.9 * torch.rand(2, 5, 3, 4)
    path = start[:, None, None] + action.cumsum(2)  # z' = z + a
    cost = InverseConsistency(inverse_model)
    torch.testing.assert_close(cost(path, start, action, start), torch.zeros(2, 5))
    assert (cost(path, start, action + 0.5, start) > 0.2).all()


def test_with_it_a_planner_stays_in_the_training_distribution(linear_world, inverse_model):
    """The goal is 10 away and there are three blocks: with the distance alone they are 3.3 long, with consistency about 1."""
    settings = {"num_candidates": 200, "num_elites": 20, "iterations": 30, "bounds": "none"}
    latent, goal = torch.zeros(1, 2), torch.tensor([[10.0, 0.0]])
    both = CostSum([GoalDistance(), InverseConsistency(inverse_model)], [1.0, 3.0], scale_free=True)
    longest = []
    for cost in (GoalDistance(), both):
        plan = make_planner("cem", linear_world(1), cost=cost, **settings).plan(latent, goal)["plan"]
        longest.append(plan.abs().max().item())
    assert longest[0] > 3 and longest[1] < 1.5


def test_a_sum_weighs_its_terms(imagined):
    predicted, goal, action, start = imagined
    cost = CostSum([PathDistance(), ActionEffort(), GoalDistance()], [0.5, 2.0, 0.0])
    expected = 0.5 * PathDistance()(predicted, goal) + 2.0 * action.square().mean((-1, -2))
    torch.testing.assert_close(cost(*imagined), expected)


class Scaled(nn.Module):
    """Another cost in other units."""

    def __init__(self, cost, scale, shift):
        super().__init__()
        self.cost, self.scale, self.shift = cost, scale, shift

    def forward(self, predicted, goal, action):
        cost = self.cost(predicted, goal, action) if isinstance(self.cost, ActionEffort) else self.cost(predicted, goal)
        return self.scale * cost + self.shift


@pytest.mark.parametrize(("scale", "shift"), [(100.0, 0.0), (0.01, 1.0), (7.0, -30.0)])
def test_a_scale_free_sum_prefers_the_same_whatever_the_units(imagined, scale, shift):
    """Differences between candidates, in units of the first term, do not depend on the units of either term."""

    def preferences(first, second):
        cost = CostSum([first, second], [1.0, 0.5], scale_free=True)(*imagined)  # [E, K]
        return (cost - cost.mean(1, keepdim=True)) / cost.std(1, keepdim=True)

    expected = preferences(GoalDistance(), ActionEffort())
    for pair in (
        (Scaled(GoalDistance(), scale, shift), ActionEffort()),
        (GoalDistance(), Scaled(ActionEffort(), scale, shift)),
    ):
        torch.testing.assert_close(preferences(*pair), expected, rtol=1e-3, atol=1e-3)
    plain = CostSum([GoalDistance(), Scaled(ActionEffort(), scale, shift)], [1.0, 0.5])(*imagined)
    assert not torch.allclose((plain - plain.mean(1, keepdim=True)) / plain.std(1, keepdim=True), expected, atol=1e-2)


def test_half_the_weight_is_half_the_standard_deviation(imagined):
    """In every environment, of the second term relative to the first."""
    predicted, goal, *_ = imagined
    first = GoalDistance()(predicted, goal)
    part = CostSum([GoalDistance(), ActionEffort()], [1.0, 0.5], scale_free=True)(*imagined) - first
    torch.testing.assert_close(part.std(1), 0.5 * first.std(1))


def test_the_cost_of_a_single_plan_is_its_first_term(imagined):
    predicted, goal, action, start = imagined
    cost = CostSum([GoalDistance(), ActionEffort()], [2.0, 0.5], scale_free=True)
    alone = cost(predicted[:, :1], goal, action[:, :1], start)
    torch.testing.assert_close(alone, 2 * GoalDistance()(predicted[:, :1], goal))


def test_a_constant_term_has_no_influence(imagined):
    """Although its scale would be infinite: the cost is that of the first term, and its gradient is zero instead of NaN."""
    predicted, goal, action, start = imagined
    same = torch.ones_like(action).requires_grad_()
    cost = CostSum([GoalDistance(), ActionEffort()], [1.0, 0.5], scale_free=True)(predicted, goal, same, start)
    torch.testing.assert_close(cost, GoalDistance()(predicted, goal))
    (gradient,) = torch.autograd.grad(cost.sum(), same)
    assert (gradient == 0).all()


@pytest.mark.parametrize(("terms", "weights"), [([], []), ([GoalDistance()], [1.0, 2.0])])
def test_a_sum_without_terms_or_with_other_weights_is_refused(terms, weights):
    with pytest.raises(ValueError, match="at least one term and a weight for each"):
        CostSum(terms, weights)


class NamesAction(nn.Module):
    def forward(self, predicted, goal, action):
        return (predicted[:, :, -1] - goal[:, None]).square().sum(-1) + 0 * action.sum((-1, -2))


class NamesStart(nn.Module):
    def forward(self, predicted, goal, start):
        return (predicted[:, :, -1] - goal[:, None]).square().sum(-1) + 0 * start.sum(-1, keepdim=True)


def function(predicted, goal):
    return (predicted[:, :, -1] - goal[:, None]).square().sum(-1)


def takes_all(predicted, goal, **extra):
    assert set(extra) == {"action", "start", "time_to_go"}
    assert extra["action"].shape[:3] == predicted.shape[:3] and extra["start"].shape == goal.shape
    return function(predicted, goal)


def settled(predicted, goal, power):
    return (predicted[:, :, -1] - goal[:, None]).pow(power).sum(-1)


@pytest.mark.parametrize(
    "cost",
    [
        NamesAction(),
        NamesStart(),
        function,
        takes_all,
        functools.partial(settled, power=2),
        CostSum([GoalDistance()], [1.0]),
        CostSum([GoalDistance(), NamesStart()], [0.5, 0.5]),
        torch.compile(NamesAction(), backend="eager"),
        torch.compile(NamesStart(), backend="eager"),
        torch.compile(function, backend="eager"),
    ],
)
def test_a_cost_gets_the_arguments_that_it_names(tiny_world, cost):
    """All of these measure the distance from the goal."""
    world, latent, goal = tiny_world(), torch.randn(2, 6), torch.randn(2, 6)
    expected = make_planner("cem", world, **FAST).plan(latent, goal)
    result = make_planner("cem", world, cost=cost, **FAST).plan(latent, goal)
    torch.testing.assert_close(result["plan"], expected["plan"])
    torch.testing.assert_close(result["plan_cost"], expected["plan_cost"])


def test_start_is_the_present_and_action_the_candidates(tiny_world):
    """With a context of three frames, start is the last one; action and predicted leave out the past."""
    last = {}

    def cost(predicted, goal, action, start):
        last.update(predicted=predicted, action=action, start=start)
        return function(predicted, goal)

    context = torch.randn(1, 3, 6)
    planner = make_planner("cem", tiny_world(), cost=cost)
    plan = planner.plan(context, torch.randn(1, 6), past_action=torch.randn(1, 2, 4))["plan"]
    assert last["start"].equal(context[:, -1])
    assert last["action"].equal(plan[:, None])  # the last call is for the cost of the plan
    assert last["predicted"].shape == (1, 1, 3, 6)
