"""Claims about the time-to-go: with it, planning after every block arrives when the goal is due and stays there.

It counts down in each episode, it belongs to one environment, and a plan is only replaced by a better one.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from making import make_planner, SEARCHING
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ficreg import GoalDistance, LatentPlanner, LatentWorldModel, MPCPolicy, PathDistance, StayDistance

HORIZON, BLOCKS, THRUST, NEAR = 5, 12, 0.1, 0.1
COSTS = {"goal": GoalDistance, "stay": StayDistance, "path": PathDistance}


class DoubleIntegrator(nn.Module):
    """Frictionless motion driven by accelerations; the velocity is the difference of the last two latents."""

    history, latent_dim, action_dim = 2, 2, 2

    def forward(self, latent, action):
        velocity = torch.diff(latent, dim=-2, prepend=latent[..., :1, :])
        return latent + velocity + THRUST * action


@pytest.fixture
def world():
    encoder = TensorDictModule(lambda pixels: pixels[..., 0, 0, :], ["pixels"], ["latent"])
    predictor = TensorDictModule(DoubleIntegrator(), ["latent", "action"], ["predicted_latent"])
    return LatentWorldModel(encoder, predictor, frame_skip=1).eval()


def picture(position):
    """[E, 2] -> [E, 3, 1, 2]."""
    return position[:, None, None].expand(-1, 3, 1, 2).clone()


def record_times(planner):
    """A list that gets the ``time_to_go`` of every plan from now on."""
    given, plan = [], planner.plan
    planner.plan = lambda *args, **kwargs: (given.append(kwargs.get("time_to_go")), plan(*args, **kwargs))[1]
    return given


@pytest.fixture
def drive(world, monkeypatch):
    """``drive(cost, **settings)``: distances from three goals after every block [3, BLOCKS], all at rest at first."""
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 512)

    def drive(cost, **settings):
        search = {"num_candidates": 60, "num_elites": 8, "iterations": 4, "horizon": HORIZON}
        policy = MPCPolicy(make_planner("icem", world, cost=COSTS[cost](), **{**search, **settings}))
        goal = torch.tensor([[0.8, 0.2], [-0.6, 0.7], [0.1, -0.8]])
        position, velocity, distance = torch.zeros_like(goal), torch.zeros_like(goal), []
        td = TensorDict({"goal_pixels": picture(goal)}, [len(goal)])
        for _ in range(BLOCKS):
            td = policy(td.set("pixels", picture(position)))
            velocity = velocity + THRUST * td["action"]
            position = position + velocity
            distance.append((position - goal).norm(dim=-1))
        return torch.stack(distance, dim=1)

    return drive


def test_with_a_constant_horizon_planning_after_every_block_is_late(drive):
    """Open loop is at the goal when it is due; closed loop could still arrive later, and does not stay either."""
    whole, again = drive("goal", receding_horizon=HORIZON), drive("goal", receding_horizon=1)
    assert (whole[:, HORIZON - 1] < NEAR).all() and (again[:, HORIZON - 1] > NEAR).all()
    assert (whole[:, HORIZON:] > NEAR).any() and (again[:, HORIZON + 1 :] > NEAR).any()


@pytest.mark.parametrize(("cost", "time_to_go"), [("goal", 5), ("stay", 5), ("stay", 4), ("path", 0)])
def test_with_a_time_to_go_it_arrives_and_stays(drive, cost, time_to_go):
    """One block late at most: the first plan does not know the velocity."""
    distance = drive(cost, receding_horizon=1, time_to_go=time_to_go, min_time_to_go=2)
    assert (distance[:, HORIZON:] < NEAR).all(), distance


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"time_to_go": 5}, [3, 3, 3, 2, 1, 1]),
        ({"time_to_go": 4, "receding_horizon": 2}, [3, 2, 1]),
        ({"time_to_go": 2, "min_time_to_go": 2}, [2, 2, 2]),
        ({"time_to_go": 2, "min_time_to_go": 9}, [3, 3]),
        ({}, [None, None]),
    ],
)
def test_it_counts_down_between_the_horizon_and_its_least_value(world, settings, expected):
    """A horizon of three blocks."""
    planner = make_planner("shooting", world, **settings)
    given, policy = record_times(planner), MPCPolicy(planner)
    td = TensorDict({"pixels": torch.zeros(2, 3, 1, 2), "goal_pixels": torch.ones(2, 3, 1, 2)}, [2])
    for _ in range(len(expected) * planner.config.receding_horizon):
        td = policy(td)
    assert [None if times is None else times.tolist() for times in given] == [e and [e, e] for e in expected]


class Resting:
    """A planner with no more than :class:`torchrl_ficreg.protocols.Planner` asks for; keeps the further keywords it is given."""

    context, action_bounds = 1, None

    def __init__(self, world, **settings):
        self.world_model, self.given = world, []
        self.config = SimpleNamespace(horizon=3, receding_horizon=1, warm_start=True, **settings)

    def plan(self, latent, goal, seeds, *, past_action, initial, **others):
        self.given.append(others)
        return TensorDict({"plan": initial, "plan_cost": torch.zeros(len(latent))}, [len(latent)])


@pytest.mark.parametrize(("settings", "expected"), [({}, [{}, {}, {}]), ({"time_to_go": 2}, [[2], [1], [1]])])
def test_a_planner_whose_settings_have_no_time_gets_none(world, settings, expected):
    planner = Resting(world, **settings)
    policy, td = MPCPolicy(planner), TensorDict({"pixels": torch.zeros(1, 3, 1, 2), "goal_pixels": torch.ones(1, 3, 1, 2)}, [1])
    for _ in range(3):
        td = policy(td)
    assert [given and given["time_to_go"].tolist() for given in planner.given] == expected


def test_in_a_new_episode_it_starts_anew(world):
    """For the environment that was reset alone."""
    planner = make_planner("shooting", world, time_to_go=3)
    given, policy = record_times(planner), MPCPolicy(planner)
    td = TensorDict({"pixels": torch.zeros(2, 3, 1, 2), "goal_pixels": torch.ones(2, 3, 1, 2)}, [2])
    for step in range(3):
        td = policy(td.set("is_init", torch.tensor([[False], [step == 2]])))
    assert [times.tolist() for times in given] == [[3, 3], [2, 2], [3], [1]]  # planned for in groups of one context length


@pytest.mark.parametrize(("search", "cost"), [("icem", "goal"), *((search, "stay") for search in SEARCHING)])
def test_environments_with_other_times_are_planned_for_as_alone(tiny_world, monkeypatch, search, cost):
    """One by one to the last bit, and side by side up to the float kernels; the cost is that of the due block."""
    planner = make_planner(search, tiny_world(), cost=COSTS[cost]())
    (latent, goal), seeds, times = torch.randn(2, 3, 6), torch.tensor([5, 6, 7]), torch.tensor([1, 2, 3])
    together = planner.plan(latent, goal, seeds, time_to_go=times)
    alone = [planner.plan(latent[e], goal[e], seeds[e], time_to_go=times[e]) for e in torch.arange(3).split(1)]
    assert together["plan"].equal(torch.cat([result["plan"] for result in alone]))
    with torch.no_grad():
        predicted = planner.world_model.rollout(latent[:, None], together["plan"])
    distance = (predicted - goal[:, None]).square().sum(-1)  # [E, horizon]
    expected = [row[t - 1] if cost == "goal" else row[t - 1 :].mean() for row, t in zip(distance, times)]
    torch.testing.assert_close(together["plan_cost"], torch.stack(expected))
    monkeypatch.setattr(LatentPlanner, "_group_size", lambda self, latent: len(latent))
    side_by_side = planner.plan(latent, goal, seeds, time_to_go=times)
    torch.testing.assert_close(side_by_side["plan"], together["plan"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("times", [[0, 1], [1, 4], [1], [[1, 2]], [1.0, 2.0]])
def test_a_time_outside_the_horizon_or_of_another_shape_is_refused(tiny_world, times):
    planner = make_planner("shooting", tiny_world())
    with pytest.raises(ValueError, match=r"time_to_go must be \[2\] numbers of blocks from 1 to horizon=3"):
        planner.plan(*torch.randn(2, 2, 6), time_to_go=torch.tensor(times))


@pytest.mark.parametrize("search", SEARCHING)
def test_with_a_fallback_a_plan_costs_no_more_than_its_start_or_no_action(tiny_world, search):
    """Searches so small that they find worse; where they find better, the plan is theirs."""
    small = {"num_candidates": 3, "num_elites": 2, "iterations": 1, "std": 5.0}
    plain, careful = (make_planner(search, tiny_world(), fallback=on, **small) for on in (False, True))
    (latent, goal), initial = torch.randn(2, 8, 6), 0.5 * torch.randn(8, 3, 4).clamp(-1, 1)
    found, kept = (planner.plan(latent, goal, initial=initial) for planner in (plain, careful))
    idle = torch.zeros_like(initial)
    with torch.no_grad():
        ends = [plain.world_model.rollout(latent[:, None], plan)[:, -1] for plan in (found["plan"], initial, idle)]
    costs = torch.stack([(end - goal).square().sum(-1) for end in ends])  # [3, 8]
    torch.testing.assert_close(kept["plan_cost"], costs.amin(0))
    options = torch.stack([found["plan"], initial, idle])  # [3, 8, 3, 4]
    assert kept["plan"].equal(options[costs.argmin(0), torch.arange(8)])
