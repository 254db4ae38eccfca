"""Claims about bounds: z-scored in every sub-step, refused where they contradict the statistics, and constants are kept."""

from __future__ import annotations

import pytest
import torch
from making import make_planner, UNIT

from torchrl_ficreg import GoalDistance, GoalPolicy
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.planners import SEARCHES

QUARTER = ([-0.25, -0.25], [0.25, 0.25])
FOREIGN = "cannot come from actions between .* another environment"


def test_bounds_are_z_scored_in_every_dimension_of_every_sub_step(linear_world):
    world = linear_world(3, mean=(0.5, -2.0), std=(0.1, 2.0))
    low, high = make_planner("cem", world, action_bounds=([-1.0, -4.0], [1.0, 0.0])).block_bounds()
    torch.testing.assert_close(low, torch.tensor([-15.0, -1.0] * 3))
    torch.testing.assert_close(high, torch.tensor([5.0, 1.0] * 3))


def test_a_mean_action_outside_the_bounds_is_not_planned(linear_world):
    """z = 0 may be illegal: bounds 1..2 around a mean of 0. The plan keeps them, whatever the goal."""
    planner = make_planner("cem", linear_world(2), action_bounds=([1.0, -2.0], [2.0, -1.0]))
    goal = torch.tensor([[0.0, 0.0], [50.0, 50.0], [-50.0, -50.0]])
    actions = planner.plan(torch.zeros(3, 2), goal)["plan"].unflatten(-1, (2, 2))
    assert (actions[..., 0] >= 1.0).all() and (actions[..., 0] <= 2.0).all()
    assert (actions[..., 1] >= -2.0).all() and (actions[..., 1] <= -1.0).all()


@pytest.mark.parametrize(
    ("bounds", "mean", "std", "message"),
    [
        (None, (0.0, 0.0), (1.0, 1.0), r"needs action_bounds=\(low, high\) in environment units, or bounds='none'"),
        (([-1.0], [1.0]), (0.0, 0.0), (1.0, 1.0), r"of shape \[2\].*another environment"),
        (([-1.0, 1.0], [1.0, -1.0]), (0.0, 0.0), (1.0, 1.0), "low <= high"),
        (UNIT, (2.0, 0.0), (0.5, 0.5), FOREIGN),  # no actions between -1 and 1 have a mean of 2
        (UNIT, (0.0, 0.0), (0.5, 1.5), FOREIGN),  # nor a std above 1
        (QUARTER, (0.0, 2.0), (0.1, 1.0), FOREIGN),  # nor is a constant outside the bounds
        (QUARTER, (0.0, -0.3), (0.1, 1.0), FOREIGN),
    ],
)
def test_bounds_that_are_impossible_or_contradict_the_statistics_are_refused(linear_world, bounds, mean, std, message):
    with pytest.raises(ValueError, match=message):
        make_planner("cem", linear_world(2, mean, std), action_bounds=bounds)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize(
    ("mean", "std", "low", "high"),
    [
        ((0.1, 0.5), (0.3, 1.0), (-1.0, 0.5), (1.0, 0.5)),  # bounds measured on the data
        ((0.0, 0.0), (0.1, 1.0), (-0.25, -0.25), (0.25, 0.25)),  # bounds narrower than the std of 1 that marks a constant
        ((0.1, 0.9), (0.3, 1.0), *UNIT),
    ],
)
def test_no_search_varies_what_the_data_never_varied(tiny_world, search, mean, std, low, high):
    """Neither in what it imagines nor in what is executed; the other component is searched."""
    world, policy = tiny_world(), GoalPolicy(latent_dim=6, action_dim=4, hidden_dim=16, depth=2).eval()
    world.statistics = ActionStatistics(torch.tensor(mean), torch.tensor(std))
    imagined = []

    def cost(predicted, goal, action):
        imagined.append(action.detach().clone().unflatten(-1, (-1, 2)))
        return GoalDistance()(predicted, goal)

    planner = make_planner(search, world, action_bounds=(low, high), cost=cost, policy=policy)
    raw = world.statistics.denormalize(planner.plan(*torch.randn(2, 3, 6))["plan"]).unflatten(-1, (-1, 2))
    torch.testing.assert_close(raw[..., 1], torch.full_like(raw[..., 1], mean[1]))
    assert all((action[..., 1] == 0).all() for action in imagined)
    assert raw[..., 0].std() > 0 and (raw[..., 0] >= low[0] - 1e-6).all() and (raw[..., 0] <= high[0] + 1e-6).all()
