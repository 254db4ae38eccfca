"""Claims about the latent CEM planner: known optima, real bounds, plans that depend on their seed alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules.planners import MPCPlannerBase

from torchrl_ficreg import GoalDistance, LatentCEMPlanner, PlanConfig

pytestmark = pytest.mark.usefixtures("fast_bf16")

SEARCH = {"num_candidates": 64, "num_elites": 8, "iterations": 20, "horizon": 3, "receding_horizon": 1}
FAST = {**SEARCH, "num_candidates": 16, "num_elites": 4, "iterations": 3, "precision": "fp32"}
UNIT = ([-1.0, -1.0], [1.0, 1.0])


def travelled(plan):
    """Way [E, 2] that a plan [E, horizon, F * 2] goes in the linear world."""
    return plan.unflatten(-1, (-1, 2)).sum((1, 2))


@pytest.mark.parametrize("bounds", ["none", "environment"])
def test_a_reachable_goal_is_reached(linear_world, bounds):
    """Six unit steps lead at most 6 away in each direction: these goals are inside, so the optimum costs nothing."""
    config = PlanConfig(**SEARCH, bounds=bounds, precision="fp32")
    planner = LatentCEMPlanner(linear_world(), config, action_bounds=UNIT)
    start, goal = torch.randn(4, 2), torch.tensor([[3.0, -1.0], [0.0, 0.0], [-2.0, 2.0], [1.0, 3.5]])
    result = planner.plan(start, goal)
    assert result["plan_cost"].max() < 1e-2
    torch.testing.assert_close(start + travelled(result["plan"]), goal, rtol=0, atol=0.1)


def test_a_goal_out_of_reach_is_approached_at_the_bound(linear_world):
    """The optimum lies on the bound in one dimension and inside in the other: costs are (10 - 6)^2 + 0."""
    planner = LatentCEMPlanner(linear_world(), PlanConfig(**SEARCH, precision="fp32"), action_bounds=UNIT)
    result = planner.plan(torch.zeros(2, 2), torch.tensor([[10.0, 1.0], [1.0, -10.0]]))
    for plan, active, sign in zip(result["plan"], (0, 1), (1.0, -1.0)):
        torch.testing.assert_close(plan[:, active::2], torch.full((3, 2), sign), rtol=0, atol=0.02)
    torch.testing.assert_close(result["plan_cost"], torch.tensor([16.0, 16.0]), rtol=0.03, atol=0)
    assert result["plan"].abs().max() <= 1.0


def test_without_bounds_it_goes_beyond(linear_world):
    planner = LatentCEMPlanner(linear_world(), PlanConfig(**SEARCH, bounds="none", precision="fp32"))
    assert planner.block_bounds() is None
    result = planner.plan(torch.zeros(1, 2), torch.tensor([[10.0, 0.0]]))
    assert result["plan"].max() > 1.0
    assert result["plan_cost"].item() < 1.0


def test_bounds_are_z_scored_in_every_dimension_of_every_sub_step(linear_world):
    world = linear_world(3, mean=(0.5, -2.0), std=(0.1, 2.0))
    planner = LatentCEMPlanner(world, PlanConfig(**FAST), action_bounds=([-1.0, -4.0], [1.0, 0.0]))
    low, high = planner.block_bounds()
    torch.testing.assert_close(low, torch.tensor([-15.0, -1.0] * 3))
    torch.testing.assert_close(high, torch.tensor([5.0, 1.0] * 3))


def test_a_mean_action_outside_the_bounds_is_not_planned(linear_world):
    """z = 0 may be illegal: bounds 1..2 around a mean of 0. The plan keeps them, whatever the goal."""
    world = linear_world(2, mean=(0.0, 0.0), std=(1.0, 1.0))
    planner = LatentCEMPlanner(world, PlanConfig(**FAST), action_bounds=([1.0, -2.0], [2.0, -1.0]))
    plan = planner.plan(torch.zeros(3, 2), torch.tensor([[0.0, 0.0], [50.0, 50.0], [-50.0, -50.0]]))["plan"]
    actions = plan.unflatten(-1, (2, 2))
    assert (actions[..., 0] >= 1.0).all() and (actions[..., 0] <= 2.0).all()
    assert (actions[..., 1] >= -2.0).all() and (actions[..., 1] <= -1.0).all()


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_plan_depends_on_its_seed_alone(tiny_world, precision):
    """The same bits alone, among seven, and in any order."""
    planner = LatentCEMPlanner(tiny_world(), PlanConfig(**{**FAST, "precision": precision}), action_bounds=UNIT)
    latent, goal, seeds = torch.randn(7, 6), torch.randn(7, 6), torch.tensor([3, 1, 4, 15, 92, 65, 35])
    together = planner.plan(latent, goal, seeds)
    order = torch.randperm(7)
    shuffled = planner.plan(latent[order], goal[order], seeds[order])
    for key in ("plan", "plan_cost"):
        assert shuffled[key].equal(together[key][order])
        for row in torch.arange(7).split(1):
            assert planner.plan(latent[row], goal[row], seeds[row])[key].equal(together[key][row])


def test_seeds_differ_and_the_global_generator_is_not_touched(tiny_world):
    world, latent, goal = tiny_world(), torch.randn(1, 6).expand(3, -1), torch.randn(1, 6).expand(3, -1)
    state = torch.get_rng_state()
    plan = LatentCEMPlanner(world, PlanConfig(**FAST), action_bounds=UNIT).plan(latent, goal)["plan"]
    other = LatentCEMPlanner(world, PlanConfig(**FAST, seed=1), action_bounds=UNIT).plan(latent, goal)["plan"]
    assert torch.get_rng_state().equal(state)
    assert not plan[0].equal(plan[1])  # seeds 0, 1, 2 by default
    assert not plan[0].equal(other[0])  # PlanConfig.seed


def test_plan_cost_is_the_cost_of_the_plan(tiny_world):
    world = tiny_world()
    latent, goal = torch.randn(3, 6), torch.randn(3, 6)
    result = LatentCEMPlanner(world, PlanConfig(**FAST), action_bounds=UNIT).plan(latent, goal)
    end = world.rollout(latent[:, None], result["plan"])[:, -1]
    torch.testing.assert_close(result["plan_cost"], (end - goal).square().sum(-1))


def test_another_cost_is_searched_just_as_well(linear_world):
    """A cost of one's own [E, K]: here, stay close to (1, 1) at every step."""

    class Path(nn.Module):
        def forward(self, predicted, goal):
            return (predicted - 1).square().sum((-1, -2))

    config = PlanConfig(**{**SEARCH, "num_candidates": 256, "num_elites": 32}, bounds="none", precision="fp32")
    planner = LatentCEMPlanner(linear_world(1), config, cost=Path())
    plan = planner.plan(torch.zeros(1, 2), torch.zeros(1, 2))["plan"]
    expected = torch.tensor([[[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]])
    torch.testing.assert_close(plan, expected, rtol=0, atol=0.05)


def test_candidate_0_is_the_mean_of_the_elites_before(linear_world):
    """In a linear world the way of the mean is the mean of the ways; the first mean is standing still."""

    class Noted(GoalDistance):
        def forward(self, predicted, goal):
            ways.append(predicted[0, :, -1])  # [K, 2]
            return super().forward(predicted, goal)

    ways, goal = [], torch.tensor([[2.0, 1.0]])
    config = PlanConfig(**FAST, bounds="none")
    LatentCEMPlanner(linear_world(), config, cost=Noted()).plan(torch.zeros(1, 2), goal)
    assert (ways[0][0] == 0).all()
    for before, after in zip(ways, ways[1:]):
        elites = (before - goal).square().sum(-1).topk(config.num_elites, largest=False).indices
        torch.testing.assert_close(after[0], before[elites].mean(0))


def test_it_is_a_torchrl_planner_and_a_tensordict_module(linear_world):
    planner = LatentCEMPlanner(linear_world(), PlanConfig(**FAST), action_bounds=UNIT)
    assert isinstance(planner, MPCPlannerBase)
    td = TensorDict({"latent": torch.randn(2, 2), "goal_latent": torch.randn(2, 2), "other": torch.ones(2)}, [2])
    td["plan_seed"] = torch.tensor([5, 6])
    expected = planner.plan(td["latent"], td["goal_latent"], td["plan_seed"])
    assert planner(td) is td
    assert set(td.keys()) == {"latent", "goal_latent", "other", "plan_seed", "plan", "plan_cost", "action"}
    assert td["plan"].equal(expected["plan"])
    assert td["action"].equal(expected["plan"][:, 0])
    assert set(planner.out_keys) == {"action", "plan", "plan_cost"}
    assert len(planner.state_dict()) == len(planner.world_model.state_dict())  # the model once


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_elites": 1}, "between 2 and num_candidates=300, got 1"),
        ({"num_elites": 301}, "between 2 and num_candidates=300, got 301"),
        ({"iterations": 0}, "must be positive"),
        ({"receding_horizon": 6}, "receding_horizon at most horizon, got 30, 5 and 6"),
        ({"std": 0.0}, "std must be positive, got 0.0"),
        ({"std": float("nan")}, "std must be positive, got nan"),
        *[({name: float("inf")}, f"{name} must be finite") for name in ("std", "memory_budget", "proposal_std")],
        *[({name: 10**12}, f"{name} must be at most 1000000") for name in ("num_candidates", "iterations", "horizon")],
        ({"bounds": "env"}, "unknown bounds 'env': choose 'environment' or 'none'"),
        ({"precision": "fp16"}, "unknown precision 'fp16'"),
        ({"seed": -1}, "seed must not be negative, got -1"),
    ],
)
def test_impossible_settings_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        PlanConfig(**wrong)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (None, r"needs action_bounds=\(low, high\) in environment units, or PlanConfig\(bounds='none'\)"),
        (([-1.0], [1.0]), r"of shape \[2\].*another environment"),
        (([-1.0, 1.0], [1.0, -1.0]), "low <= high"),
    ],
)
def test_impossible_bounds_are_refused(linear_world, bounds, message):
    with pytest.raises(ValueError, match=message):
        LatentCEMPlanner(linear_world(), PlanConfig(), action_bounds=bounds)


@pytest.mark.parametrize(("mean", "std"), [((2.0, 0.0), (0.5, 0.5)), ((0.0, 0.0), (0.5, 1.5))])
def test_statistics_that_cannot_come_from_the_bounds_are_refused(linear_world, mean, std):
    """No actions between -1 and 1 have mean 2, or a standard deviation above 1."""
    with pytest.raises(ValueError, match="cannot come from actions between .* another environment"):
        LatentCEMPlanner(linear_world(2, mean, std), PlanConfig(), action_bounds=UNIT)


@pytest.mark.parametrize("shapes", [((2, 2), (3, 2), 2), ((2, 2), (2, 2), 3), ((2, 2, 2), (2, 2), 2), ((2,), (2,), 2)])
def test_inputs_of_other_shapes_are_refused(linear_world, shapes):
    latent, goal, seeds = shapes
    planner = LatentCEMPlanner(linear_world(), PlanConfig(**FAST), action_bounds=UNIT)
    with pytest.raises(ValueError, match=r"expected latents \[E, 2\] or \[E, C, 2\], goals \[E, 2\]|past_action"):
        planner.plan(torch.zeros(latent), torch.zeros(goal), torch.arange(seeds))


def test_a_world_model_in_train_mode_is_refused(tiny_world):
    """Dropout would blur the plans, and imagined latents would move the BatchNorm statistics."""
    world = tiny_world()
    planner = LatentCEMPlanner(world, PlanConfig(**FAST), action_bounds=UNIT)
    world.predictor.train()
    with pytest.raises(ValueError, match=r"train mode.*call its eval\(\)"):
        planner.plan(torch.zeros(1, 6), torch.zeros(1, 6))


@pytest.mark.parametrize(("candidates", "groups"), [(16, [7]), (100, [5, 2]), (257, [1] * 7)])
def test_few_candidates_share_calls_on_a_cpu(tiny_world, monkeypatch, candidates, groups):
    """Up to 512 candidates at once, and the same plans up to the float kernels."""
    planner = LatentCEMPlanner(tiny_world(), PlanConfig(**{**FAST, "num_candidates": candidates}), action_bounds=UNIT)
    latent, goal = torch.randn(2, 7, 6)
    alone = planner.plan(latent, goal)
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 512)
    sizes, search = [], planner._search
    monkeypatch.setattr(planner, "_search", lambda problem: (sizes.append(len(problem.goal)), search(problem))[1])
    torch.testing.assert_close(planner.plan(latent, goal)["plan"], alone["plan"], rtol=1e-3, atol=1e-4)
    assert sizes == groups
