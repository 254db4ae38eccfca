"""Claims about the MPC policy: blocks served action by action, plans made when due, environments left to themselves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import get_type_hints

import pytest
import torch
from making import make_planner
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_ficreg import (
    CostSum,
    GoalDistance,
    GoalPolicy,
    InverseConsistency,
    LatentPlanner,
    make_world_model,
    ModelConfig,
    MPCPolicy,
    PlanConfig,
    protocols,
)
from torchrl_ficreg.envs import make_env
from torchrl_ficreg.planners import SEARCHES


class Counted(LatentPlanner):
    """Plans 0, 1, 2, ... in units of 0.001, plus the first latent, and records for which environments."""

    planned: list[float]

    def _search(self, problem):
        latent = problem.latent  # [e, 1, D]
        self.__dict__.setdefault("planned", []).extend(latent[:, 0, 0].tolist())
        block = self.world_model.block_dim
        plan = torch.arange(self.config.horizon * block).view(1, self.config.horizon, block) * 0.001 + latent[:, :, :1]
        return TensorDict({"plan": plan, "plan_cost": latent[:, 0, 0]}, [len(latent)])


def scene(*corner):
    """Frames [E, 3, 4, 4] whose first pixel is each of the given numbers."""
    pixels = torch.zeros(len(corner), 3, 4, 4, dtype=torch.uint8)
    pixels[:, 0, 0, 0] = torch.tensor(corner, dtype=torch.uint8)
    return TensorDict({"pixels": pixels, "goal_pixels": torch.zeros_like(pixels)}, [len(corner)])


def counted(world, receding_horizon=2):
    return Counted(world, PlanConfig(horizon=3, receding_horizon=receding_horizon, bounds="none", precision="fp32"))


def test_a_block_is_served_action_by_action_in_environment_units(linear_world):
    """F = 3 actions of A = 2 numbers, time-major: 0 1, 2 3, 4 5, then the next block; then a new plan."""
    world = linear_world(3, mean=(10.0, 20.0), std=(1.0, 2.0))
    planner = counted(world)
    policy, td = MPCPolicy(planner), scene(7)
    served = []
    for _ in range(8):
        td = policy(td)
        served.append(td["action"][0])
    expected = (torch.arange(12).view(6, 2) * 0.001 + 7) * torch.tensor([1.0, 2.0]) + torch.tensor([10.0, 20.0])
    torch.testing.assert_close(torch.stack(served[:6]), expected)
    torch.testing.assert_close(torch.stack(served[6:]), expected[:2])
    assert planner.planned == [7.0, 7.0]


@pytest.mark.parametrize("receding_horizon", [1, 2, 3])
def test_a_plan_is_made_every_receding_horizon_blocks(linear_world, receding_horizon):
    planner = counted(linear_world(2), receding_horizon)
    policy, td, counts = MPCPolicy(planner), scene(1, 2), []
    for _ in range(12):
        td = policy(td)
        counts.append(td["mpc", "count"].tolist())
    assert counts == [[1 + step // (2 * receding_horizon)] * 2 for step in range(12)]
    assert len(planner.planned) == 2 * counts[-1][0]


def test_a_reset_environment_is_planned_for_alone(linear_world):
    planner = counted(linear_world(2))
    policy, td = MPCPolicy(planner), scene(1, 2, 3)
    td = policy(policy(td))
    planner.planned.clear()
    td["is_init"] = torch.tensor([[False], [True], [False]])
    td["pixels"][1, 0, 0, 0] = 50
    td = policy(td)
    assert planner.planned == [50.0]
    assert td["mpc", "count"].tolist() == [1, 1, 1]
    assert td["mpc", "cursor"].tolist() == [3, 1, 3]
    torch.testing.assert_close(td["action"][:, 0], torch.tensor([1.004, 50.0, 3.004]))
    torch.testing.assert_close(td["mpc", "plan_cost"], torch.tensor([1.0, 50.0, 3.0]))


@pytest.mark.parametrize("search", sorted(SEARCHES))
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_a_policy_cast_as_a_whole_plans_in_its_dtype(dtype, search, fast_bf16):
    """Queue and plan follow the model's dtype, through several plans; the cost stays a float32.

    The predictor, the goal policy and the inverse model of the cost are cast with it.
    """
    model, inverse = make_world_model(ModelConfig.preset("cpu", latent_dim=4, history=2), action_dim=2)
    small = {"num_candidates": 4, "num_elites": 2, "iterations": 1, "horizon": 2, "precision": "auto"}
    cost = CostSum([GoalDistance(), InverseConsistency(inverse.eval())], [1.0, 0.5], scale_free=True)
    planner = make_planner(search, model.eval(), cost=cost, policy=GoalPolicy(latent_dim=4, action_dim=10), **small)
    policy = MPCPolicy(planner).to(dtype)
    frame = torch.zeros(2, 3, 64, 64, dtype=torch.uint8)
    td = TensorDict({"pixels": frame, "goal_pixels": frame}, [2])
    for _ in range(6):
        td = policy(td)
    assert td["action"].dtype == td["mpc", "plan"].dtype == dtype and td["action"].abs().max() <= 1
    assert td["mpc", "plan_cost"].dtype == torch.float32 and td["mpc", "count"].tolist() == [2, 2]


def test_its_memory_is_in_the_tensordict_alone(linear_world):
    """Two rollouts interleaved through one policy do not mix, and an earlier tensordict is not written to."""
    policy = MPCPolicy(counted(linear_world(2)))
    first, second = policy(scene(1)), policy(scene(2))
    kept = first.clone()
    later = policy(first.clone())
    assert (first == kept).all()
    torch.testing.assert_close(later["action"], torch.tensor([[1.002, 1.003]]))
    torch.testing.assert_close(policy(second)["action"], torch.tensor([[2.002, 2.003]]))
    before = kept["mpc"].clone()
    policy(kept)
    assert (before == first["mpc"]).all()


def test_other_keys_are_left_alone(linear_world):
    td = scene(1, 2)
    td["state"], td["nested", "goal"] = torch.randn(2, 5), torch.randn(2, 3)
    before = td.clone()
    result = MPCPolicy(counted(linear_world()))(td)
    assert result is td
    assert set(td.keys()) - set(before.keys()) == {"action", "mpc"}
    assert (td.select(*before.keys()) == before).all()


def test_a_planner_needs_no_more_than_its_protocol(linear_world):
    world, config = linear_world(), PlanConfig(horizon=2, receding_horizon=1)

    def plan(latent, goal, seeds=None, *, past_action=None, initial=None):
        block = world.statistics.normalize(torch.tensor([0.5, -0.5])).repeat(world.frame_skip)
        return TensorDict({"plan": block.expand(*initial.shape), "plan_cost": torch.zeros(len(latent))}, [len(latent)])

    own = {"world_model": world, "config": config, "context": 1, "action_bounds": None, "plan": plan}
    assert own.keys() == get_type_hints(protocols.Planner).keys() | {"plan"}
    pixels = torch.zeros(3, 3, 8, 8, dtype=torch.uint8)
    td = TensorDict({"pixels": pixels, "goal_pixels": pixels}, [3])
    torch.testing.assert_close(MPCPolicy(SimpleNamespace(**own))(td)["action"], torch.tensor([[0.5, -0.5]]).expand(3, 2))
    with pytest.raises(ValueError, match=r"takes batches \[E\] or \[\], got \[1, 3\]"):
        MPCPolicy(SimpleNamespace(**own))(td.unsqueeze(0))


def test_an_environment_without_batch_dimension_is_served(linear_world):
    policy = MPCPolicy(counted(linear_world(2)))
    td, batched = scene(7)[0], scene(7)
    for _ in range(6):
        td, batched = policy(td), policy(batched)
        assert td.batch_size == torch.Size([])
        assert td["action"].equal(batched["action"][0])
        assert td["mpc", "count"] == batched["mpc", "count"][0]


def test_actions_never_leave_the_bounds_of_the_environment(linear_world):
    """Not by rounding either, however the statistics are: goals far away in every direction."""
    low, high = torch.tensor([-0.1, -7.3]), torch.tensor([0.3, -0.7])
    world = linear_world(2, mean=(0.13, -3.1), std=(0.17, 2.9))
    search = {"num_candidates": 200, "num_elites": 20, "iterations": 20, "receding_horizon": 3}
    policy = MPCPolicy(make_planner("cem", world, action_bounds=(low, high), **search))
    td = scene(0, 0, 255, 255)
    td["pixels"][:, 0, 0, 1] = torch.tensor([0, 255, 0, 255], dtype=torch.uint8)
    td["goal_pixels"] = 255 - td["pixels"]
    served = []
    for _ in range(12):
        td = policy(td)
        served.append(td["action"])
    served = torch.stack(served)  # [12, 4, 2]
    assert (served >= low).all() and (served <= high).all()
    away = td["goal_pixels"][:, 0, 0, :2].float() - td["pixels"][:, 0, 0, :2].float()
    torch.testing.assert_close(served.mean(0), torch.where(away > 0, high, low), rtol=0.05, atol=0.02)


def test_stepping_by_hand_is_the_same_as_a_rollout(tiny_world):
    policy = MPCPolicy(make_planner("cem", tiny_world()))
    expected = make_env("two_room", 2, image_size=16, seed=0).rollout(5, policy, break_when_any_done=False)["action"]
    env = make_env("two_room", 2, image_size=16, seed=0)
    td, actions = env.reset(), []
    for _ in range(5):
        td = env.step(policy(td))
        actions.append(td["action"])
        td = step_mdp(td, keep_other=True)
    assert torch.stack(actions, 1).equal(expected)
