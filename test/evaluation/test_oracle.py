"""The simulator as dynamics: it is the environment, and planning with it reaches goals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import make_pairs, same_room_pairs

from torchrl_ficreg import CEMConfig, ICEMConfig, LatentCEMPlanner
from torchrl_ficreg.data import ActionStatistics
from torchrl_ficreg.envs import make_env
from torchrl_ficreg.evaluation import evaluate_mpc
from torchrl_ficreg.evaluation.oracle import DrawnGoalDistance, oracle_policy, Simulator, StateDistance

BOUNDS = ([-1.0, -1.0], [1.0, 1.0])
STATISTICS = ActionStatistics(torch.tensor([0.1, -0.2]), torch.tensor([0.5, 0.4]))
SEARCH = {"horizon": 3, "receding_horizon": 3, "num_candidates": 16, "num_elites": 4, "iterations": 3, "kept_elites": 0.5}


def simulator(name: str = "two_room", **changes) -> Simulator:
    return Simulator(name, STATISTICS, frame_skip=2, image_size=16, **changes)


@pytest.mark.parametrize("name", ["two_room", "push_t", "reacher"])
def test_a_rollout_is_what_the_environment_does(name):
    """Of z-scored blocks, the first of which belong to the context; every row starts from its own state."""
    env = make_env(name, image_size=16, terminate_on_success=False)
    action = torch.randn(2, 4, 4, generator=torch.Generator().manual_seed(0)).clamp(-1, 1)
    dynamics, wanted, starts = simulator(name), [], []
    for row in range(2):
        td = env.reset(seed=row)
        starts.append(td["state"])
        states = []
        for block in STATISTICS.denormalize(action[row, 1:]).unflatten(-1, (2, 2)):
            for single in block:
                td = env.step(td.set("action", single))["next"]
            states.append(td["state"])
        wanted.append(torch.stack(states))
    context = torch.stack([torch.zeros_like(torch.stack(starts)), torch.stack(starts)], 1)  # [2, 2, S]
    found = dynamics.rollout(context, action)
    torch.testing.assert_close(found, torch.stack(wanted), atol=1e-6, rtol=1e-6)
    assert dynamics(context[:, 1:], action[:, 1:2]).equal(found[:, :1])
    assert dynamics.draw(found[0]).shape == (3, 3, 16, 16)
    env.close()


def test_the_distance_of_states_is_counted_in_tolerances():
    """PushT: 20 px of agent and block, 20 degrees of the block the shorter way around; velocities do not count."""
    goal = torch.tensor([[100.0, 100.0, 300.0, 300.0, 0.1, 0.0, 0.0]], dtype=torch.float64)
    shift = torch.tensor([[20.0, 0, 0, 40.0, 0, 9, 9], [0, 0, 0, 0, 2 * np.pi - np.deg2rad(10), 0, 0]], dtype=torch.float64)
    cost = StateDistance("push_t")((goal + shift)[None, :, None], goal)
    torch.testing.assert_close(cost, torch.tensor([[5.0, 0.25]], dtype=torch.float64))


def test_the_distance_of_drawn_states_is_that_of_their_frames(tiny_world):
    model, dynamics = tiny_world(), simulator()
    cost = DrawnGoalDistance(model, dynamics)
    states = torch.tensor([[60.0, 112.0], [150.0, 60.0]], dtype=torch.float64)
    found = cost(states.expand(3, 2, 2)[:, :, None], states[:1].expand(3, 2))  # three environments, two candidates
    latent = model.encode(dynamics.draw(states)).detach()
    torch.testing.assert_close(found, torch.tensor([[0.0, (latent[1] - latent[0]).square().sum()]]).double().expand(3, 2))


@pytest.fixture
def guide(tiny_world) -> LatentCEMPlanner:
    config = CEMConfig(horizon=3, receding_horizon=3, num_candidates=8, num_elites=2, iterations=1)
    return LatentCEMPlanner(tiny_world(), config, action_bounds=BOUNDS)


def test_true_states_lead_to_the_goals_and_every_sequence_is_counted(guide):
    count = [0]

    def tick():
        count[0] += 1

    pairs = make_pairs([[60.0, 112.0]] * 2, [[60.0, 150.0], [90.0, 90.0]])
    config = ICEMConfig(**{**SEARCH, "horizon": 6, "receding_horizon": 6, "num_candidates": 32})
    dynamics = Simulator("two_room", STATISTICS, frame_skip=2, image_size=16, on_sequence=tick)
    policy = oracle_policy(dynamics, guide.world_model, config, action_bounds=BOUNDS, cost=StateDistance("two_room"))
    outcome = evaluate_mpc(policy, pairs, budget=12, image_size=16, progress_bar=False)
    assert outcome.success_rate == 1 and not outcome.at_start.any()
    assert count[0] == 2 * policy.planner.sequences_per_plan


def test_a_guided_plan_is_never_worse_than_that_of_its_guide(guide):
    dynamics, cost = simulator(), StateDistance("two_room")
    policy = oracle_policy(dynamics, guide.world_model, ICEMConfig(**SEARCH), action_bounds=BOUNDS, cost=cost, guide=guide)
    pairs = same_room_pairs(4)
    start, goal = torch.from_numpy(pairs.start_state), torch.from_numpy(pairs.goal_state)
    encode = policy.planner.encode_state
    guided = guide.plan(encode(start), encode(goal))["plan"]
    unaided = cost(dynamics.rollout(start[:, None], guided)[:, None], goal)[:, 0]
    assert (policy.planner.plan(start, goal)["plan_cost"] <= unaided + 1e-9).all()
    with pytest.raises(ValueError, match="the guide plans 3 blocks, the oracle 4"):
        config = ICEMConfig(**{**SEARCH, "horizon": 4})
        oracle_policy(dynamics, guide.world_model, config, action_bounds=BOUNDS, guide=guide)
