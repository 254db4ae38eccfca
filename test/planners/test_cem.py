"""The latent CEM planner, beside what holds for all searches: its mean, its seeds, and a search of one's own."""

from __future__ import annotations

import torch
from making import make_planner

from torchrl_ficreg import CEMConfig, GoalDistance
from torchrl_ficreg.planners import SamplingPlanner


def test_seeds_differ_and_the_global_generator_is_not_used(tiny_world):
    world, latent, goal = tiny_world(), torch.randn(1, 6).expand(3, -1), torch.randn(1, 6).expand(3, -1)
    state = torch.get_rng_state()
    plan, other = (make_planner("cem", world, seed=seed).plan(latent, goal)["plan"] for seed in (0, 1))
    assert torch.get_rng_state().equal(state)
    assert not plan[0].equal(plan[1])  # seeds 0, 1, 2 by default
    assert not plan[0].equal(other[0])


def test_candidate_0_is_the_mean_of_the_elites_before(linear_world):
    """In a linear world the way of the mean is the mean of the ways; the first mean is standing still."""

    def cost(predicted, goal):
        ways.append(predicted[0, :, -1])  # [K, 2]
        return GoalDistance()(predicted, goal)

    ways, goal = [], torch.tensor([[2.0, 1.0]])
    make_planner("cem", linear_world(), cost=cost, iterations=3, bounds="none").plan(torch.zeros(1, 2), goal)
    assert (ways[0][0] == 0).all()
    for before, after in zip(ways, ways[1:]):
        elites = (before - goal).square().sum(-1).topk(4, largest=False).indices
        torch.testing.assert_close(after[0], before[elites].mean(0))


def test_a_users_own_search_defines_one_update(linear_world):
    class BestOnly(SamplingPlanner):
        def _fit(self, elites, cost, mean, std):
            return elites[:, 0], 0.8 * std

    planner = BestOnly(linear_world(), CEMConfig(num_candidates=64, num_elites=2, horizon=3, receding_horizon=1, bounds="none"))
    assert planner.plan(torch.zeros(1, 2), torch.tensor([[3.0, -1.0]]))["plan_cost"].item() < 0.05
