"""Claims about planning in bfloat16: about the same plans, and a world model that stays float32 come what may."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_ficreg import GoalDistance, LatentCEMPlanner, PlanConfig

SEARCH = {"num_candidates": 32, "num_elites": 6, "iterations": 12, "horizon": 3, "receding_horizon": 1}
UNIT = ([-1.0, -1.0], [1.0, 1.0])


def snapshot(world):
    return {name: (id(value), value.dtype, value.detach().clone()) for name, value in tensors(world)}


def tensors(world):
    return [*world.named_parameters(), *world.named_buffers()]


def unchanged(world, before):
    now = dict(tensors(world))
    return set(now) == set(before) and all(
        id(value) == before[name][0] and value.dtype == before[name][1] and value.equal(before[name][2])
        for name, value in now.items()
    )


class Interrupted(nn.Module):
    """A cost that fails in the middle of the search."""

    def __init__(self, error, at=3):
        super().__init__()
        self.error, self.calls, self.at = error, 0, at

    def forward(self, predicted, goal):
        self.calls += 1
        if self.calls == self.at:
            raise self.error
        return GoalDistance()(predicted, goal)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_planning_changes_nothing_in_the_world_model(tiny_world, precision):
    """Not a bit, not a dtype, not even which objects its parameters are."""
    world = tiny_world()
    before = snapshot(world)
    LatentCEMPlanner(world, PlanConfig(**SEARCH, precision=precision), action_bounds=UNIT).plan(
        torch.randn(2, 6), torch.randn(2, 6)
    )
    assert unchanged(world, before)
    assert all(param.requires_grad and param.grad is None for param in world.parameters())


@pytest.mark.parametrize("error", [ValueError("no such goal"), KeyboardInterrupt(), torch.OutOfMemoryError("full")])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_nor_does_an_error_or_an_interruption_inside(tiny_world, precision, error):
    world = tiny_world()
    before = snapshot(world)
    config = PlanConfig(**SEARCH, precision=precision)
    latent, goal = torch.randn(2, 6), torch.randn(2, 6)
    expected = LatentCEMPlanner(world, config, action_bounds=UNIT).plan(latent, goal)["plan"]
    planner = LatentCEMPlanner(world, config, action_bounds=UNIT, cost=Interrupted(error))
    with pytest.raises(type(error)):
        planner.plan(latent, goal)
    assert unchanged(world, before)
    assert planner.plan(latent, goal)["plan"].equal(expected)


def test_weights_trained_further_are_planned_with(tiny_world):
    """The bfloat16 copy is brought up to date for every plan: no stale weights between two of them."""
    world = tiny_world()
    planner = LatentCEMPlanner(world, PlanConfig(**SEARCH, precision="bf16"), action_bounds=UNIT)
    latent, goal = torch.randn(1, 6), torch.randn(1, 6)
    before = planner.plan(latent, goal)["plan_cost"]
    with torch.no_grad():
        world.predictor.module.projector.layer_out.bias.add_(5.0)
    assert not planner.plan(latent, goal)["plan_cost"].equal(before)


def test_both_precisions_find_the_same_optimum(linear_world):
    goal = torch.tensor([[2.0, -1.0], [10.0, 0.0]])
    results = [
        LatentCEMPlanner(linear_world(), PlanConfig(**SEARCH, precision=precision), action_bounds=UNIT).plan(
            torch.zeros(2, 2), goal
        )
        for precision in ("fp32", "bf16")
    ]
    ways = [result["plan"].unflatten(-1, (-1, 2)).sum((1, 2)) for result in results]
    torch.testing.assert_close(ways[0], torch.tensor([[2.0, -1.0], [6.0, 0.0]]), rtol=0, atol=0.2)
    torch.testing.assert_close(ways[1], ways[0], rtol=0, atol=0.2)
    assert results[1]["plan"].dtype == results[1]["plan_cost"].dtype == torch.float32


def test_imagined_costs_agree_to_bfloat16(tiny_world):
    """The cost of one and the same plan, not of two searches."""
    world, latent, goal = tiny_world(), torch.randn(4, 6), torch.randn(4, 6)
    plans = torch.randn(4, 1, 3, 4)
    costs = []
    for precision in ("fp32", "bf16"):
        planner = LatentCEMPlanner(world, PlanConfig(**SEARCH, precision=precision), action_bounds=UNIT)
        dynamics = planner._fast.of(world) if precision == "bf16" else world
        with torch.no_grad():
            costs.append(planner._imagined_cost(dynamics, latent[:, None], torch.zeros(4, 0, 4), goal, plans))
    torch.testing.assert_close(costs[1], costs[0], rtol=0.1, atol=0.1)
    assert not costs[1].equal(costs[0])
