"""Claims about the imagined environment: its steps are those of rollout(), and TorchRL's own planners plan on it."""

from __future__ import annotations

import pytest
import torch
from making import UNIT
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs
from torchrl.modules.planners import CEMPlanner, MPPIPlanner

from torchrl_ficreg import LatentGoalEnv

SEARCH = {"optim_steps": 8, "num_candidates": 64, "top_k": 8}


def start_of(latent, goal):
    return TensorDict({"latent": latent, "goal_latent": goal}, latent.shape[:-1])


def random_start(*lead, dim=6):
    return start_of(torch.randn(*lead, dim), torch.randn(*lead, dim))


def play(env, start, action):
    """The rollout [..., T] of given blocks [..., T, F * A]."""
    return env.rollout(action.shape[-2], actions=action.unbind(-2), tensordict=start)


def distance(latent, goal):
    return (latent - goal).square().sum(-1)


def cem(env, horizon):
    return CEMPlanner(env, horizon, **SEARCH)


def mppi(env, horizon):
    """The recipe of the class docstring."""

    def behind_best(reward):
        total = reward.sum(-2, keepdim=True)
        std = total.std(-3, keepdim=True).clamp_min(1e-6)
        return ((total - total.amax(-3, keepdim=True)) / std).expand_as(reward)

    advantage = TensorDictModule(behind_best, [("next", "reward")], ["advantage"])
    return MPPIPlanner(env, advantage, temperature=1.0, planning_horizon=horizon, **SEARCH)


def arrive(make, env, start, steps):
    """Plans again after every step, as far ahead as there are steps left; returns the last latent [..., D]."""
    td = env.reset(start)
    for left in range(steps, 0, -1):
        td = env.step_mdp(env.step(make(env, left)(td)))
    return td["latent"]


@pytest.mark.parametrize("bounds", [None, UNIT])
@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("history", [1, 3])
def test_its_specs_describe_its_steps(tiny_world, history, lead, bounds):
    """TorchRL's check, at every batch size; it leaves out the state, which is compared here."""
    env = LatentGoalEnv(tiny_world(history=history), action_bounds=bounds)
    assert not env.batch_locked
    start = env.reset(random_start(*lead))
    check_env_specs(env, tensordict=start.clone())
    stepped = env.rand_step(start)["next"]
    expected = {**env.observation_spec, **env.full_reward_spec, **env.full_done_spec}
    found = {key: (value.shape, value.dtype) for key, value in stepped.items()}
    assert found == {key: ((*lead, *spec.shape), spec.dtype) for key, spec in expected.items()}


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("history", [1, 2, 3])
def test_stepping_is_the_rollout_of_the_world_model(tiny_world, history, lead):
    """Horizon 6 is longer than every window: it grows, then slides. In float64, to detect any padding."""
    model = tiny_world(history=history).double()
    start, action = random_start(*lead).double(), torch.randn(*lead, 6, 4, dtype=torch.float64)
    played = play(LatentGoalEnv(model), start.clone(), action)
    imagined = model.rollout(start["latent"].unsqueeze(-2), action)
    torch.testing.assert_close(played["next", "latent"], imagined, rtol=0, atol=1e-12)
    assert played["goal_latent"].equal(start["goal_latent"].unsqueeze(-2).expand_as(imagined))
    assert not played["next", "done"].any()


def test_the_past_is_what_was_executed(tiny_world):
    """After five steps a predictor of history 3 has the last two latents and the blocks after them; a reset clears them."""
    env, action = LatentGoalEnv(tiny_world()), torch.randn(2, 5, 4)
    played = play(env, random_start(2), action)
    last = played[:, -1]["next"]
    assert last["past_action"].equal(action[:, -2:]) and last["past_latent"].equal(played["latent"][:, -2:])
    assert played["past_length"][0, :, 0].tolist() == [0, 1, 2, 2, 2]
    again = env.reset(last.clone())
    assert again["latent"].equal(last["latent"])
    assert not any(again[key].any() for key in ("past_length", "past_latent", "past_action"))


def test_rows_that_were_reset_at_different_times_do_not_mix(tiny_world):
    """Rows that have made no, one, two and four steps get the same next step together as alone."""
    model = tiny_world().double()
    env, rows = LatentGoalEnv(model), []
    for steps in (0, 1, 2, 4):
        td = env.reset(random_start(1).double())
        for _ in range(steps):
            td = env.step_mdp(env.rand_step(td))
        rows.append(env.rand_action(td).exclude("next"))
    alone = torch.cat([env.step(row.clone())["next"] for row in rows])
    together = env.step(torch.cat(rows))["next"]
    assert together["past_length"].flatten().tolist() == [1, 2, 2, 2]
    for key in ("latent", "past_latent", "past_action", "reward"):
        torch.testing.assert_close(together[key], alone[key], rtol=0, atol=1e-12)


def test_rewards_are_progress_and_negative_distance(tiny_world):
    """Progress adds up to the terminal distance, relative to that of the start."""
    start, action, model = random_start(4).double(), torch.randn(4, 5, 4, dtype=torch.float64), tiny_world().double()
    progress, negative = (
        play(LatentGoalEnv(model, reward=reward), start.clone(), action)["next", "reward"] for reward in ("progress", "distance")
    )
    path, goal = model.rollout(start["latent"].unsqueeze(-2), action), start["goal_latent"]
    torch.testing.assert_close(progress.sum((-2, -1)), distance(start["latent"], goal) - distance(path[:, -1], goal))
    torch.testing.assert_close(negative, -distance(path, goal.unsqueeze(-2)).unsqueeze(-1))


@pytest.mark.parametrize("make", [cem, mppi])
@pytest.mark.parametrize("frame_skip", [1, 3])
@pytest.mark.parametrize("lead", [(), (5,), (2, 3)])
def test_stock_planners_reach_the_goal(linear_world, make, frame_skip, lead):
    """As the policy of a rollout, planning three blocks ahead at each step: at most a tenth of the distance is left."""
    torch.manual_seed(0)
    env = LatentGoalEnv(linear_world(frame_skip), reward="distance")
    goal = 3 * torch.nn.functional.normalize(torch.randn(*lead, 2), dim=-1)
    played = env.rollout(4, make(env, 3), tensordict=start_of(torch.zeros(*lead, 2), goal))
    assert played["action"].shape == (*lead, 4, 2 * frame_skip)
    assert distance(played["next", "latent"][..., -1, :], goal).max() < 9 / 10  # zero actions leave 9


@pytest.mark.parametrize("make", [cem, mppi])
@pytest.mark.parametrize("frame_skip", [1, 3])
def test_with_progress_a_goal_that_needs_every_block_is_reached(linear_world, make, frame_skip):
    """Four fifths of what the bounds allow in three blocks: every block must go towards the goal."""
    torch.manual_seed(0)
    env = LatentGoalEnv(linear_world(frame_skip), action_bounds=UNIT)
    goal = 0.8 * 3 * frame_skip * torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    end = arrive(make, env, start_of(torch.zeros(4, 2), goal), 3)
    assert (distance(end, goal) < 0.02 * distance(torch.zeros(4, 2), goal)).all()


@pytest.mark.parametrize("make", [cem, mppi])
@pytest.mark.parametrize("history", [1, 3])
def test_stock_planners_plan_on_a_transformer(tiny_world, make, history):
    """The goals are where three random blocks lead; zero actions leave more than four times the distance."""
    torch.manual_seed(0)
    model, latent = tiny_world(history=history).requires_grad_(False), torch.randn(6, 6)
    goal = model.rollout(latent.unsqueeze(1), torch.randn(6, 3, 4))[:, -1]
    idle = model.rollout(latent.unsqueeze(1), torch.zeros(6, 3, 4))[:, -1]
    end = arrive(make, LatentGoalEnv(model), start_of(latent, goal), 3)
    assert distance(end, goal).mean() < distance(idle, goal).mean() / 4


@pytest.mark.parametrize("make", [cem, mppi])
def test_bounds_hold_in_every_dimension_of_every_sub_step(linear_world, make):
    """Raw bounds through the statistics: (-1 - 0.5) / 0.5 = -3 and (1 - 0.5) / 0.5 = 1; (-4 + 2) / 2 = -1 and 1."""
    world = linear_world(3, mean=(0.5, -2.0), std=(0.5, 2.0))
    env = LatentGoalEnv(world, action_bounds=([-1.0, -4.0], [1.0, 0.0]))
    torch.testing.assert_close(env.action_spec.low, torch.tensor([-3.0, -1.0] * 3))
    torch.testing.assert_close(env.action_spec.high, torch.tensor([1.0, 1.0] * 3))
    start = start_of(torch.zeros(2, 2), torch.tensor([[90.0, 90.0], [-90.0, 0.0]]))
    action = make(env, 2)(env.reset(start))["action"]
    assert env.action_spec.is_in(action)
    assert (action[0] > 0.5).all()  # the goal is far: the plan goes to the bound
    assert (action[1, ::2] < -1.0).all()


def test_planning_and_stepping_do_not_change_their_input(tiny_world):
    """A planner adds ``action`` and a step adds ``next``; nothing else changes.

    A step keeps no graph: TorchRL's planners do not switch gradients off, and that of 150 imagined steps would accumulate.
    """
    model = tiny_world()
    env = LatentGoalEnv(model)
    td = env.step_mdp(env.rand_step(env.reset(random_start(3)))).exclude("action")
    before = td.clone()
    cem(env, 2)(td)
    assert set(td.keys()) == {*before.keys(), "action"}
    env.step(td)
    assert set(td.keys()) == {*before.keys(), "action", "next"}
    assert (td.select(*before.keys()) == before).all()
    assert any(param.requires_grad for param in model.parameters()) and not td["next", "reward"].requires_grad


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reward": "sparse"}, "unknown reward 'sparse': choose one of 'progress', 'distance'"),
        ({"action_bounds": ([-1.0], [1.0])}, r"low <= high of shape \[2\].*another environment"),
        ({"action_bounds": ([-1.0, 1.0], [1.0, -1.0])}, "low <= high"),
        ({"action_bounds": 1.0}, r"must be \(low, high\)"),
    ],
)
def test_impossible_settings_are_refused(tiny_world, arguments, message):
    with pytest.raises(ValueError, match=message):
        LatentGoalEnv(tiny_world(), **arguments)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (start_of(torch.zeros(2, 5), torch.zeros(2, 5)), r"'latent' must be \[2, 6\] .* got \[2, 5\]: encode it"),
        (start_of(torch.zeros(2, 6), torch.zeros(2, 1)), r"'goal_latent' must be \[2, 6\] .* got \[2, 1\]"),
        (TensorDict({"latent": torch.zeros(2, 6), "goal_latent": torch.zeros(2, 6)}), r"must be \[6\] .* its batch"),
        (start_of(torch.zeros(2, 6), torch.full((2, 6), torch.nan)), "'goal_latent' holds a NaN"),
        (None, r"\['latent', 'goal_latent'\] missing: encode a frame"),  # there is no default
        (TensorDict({"latent": torch.zeros(2, 6)}, [2]), r"\['goal_latent'\] missing"),
    ],
)
def test_starts_that_do_not_fit_are_refused(tiny_world, start, message):
    with pytest.raises((ValueError, KeyError), match=message):
        LatentGoalEnv(tiny_world()).reset(start)


@pytest.mark.parametrize("width", [3, 8])
@pytest.mark.parametrize("history", [1, 3])
def test_a_block_of_another_width_a_start_without_reset_and_train_mode_are_refused(tiny_world, history, width):
    model = tiny_world(history=history)
    env = LatentGoalEnv(model)
    td = env.reset(random_start(2)).set("action", torch.zeros(2, width))
    with pytest.raises(ValueError, match=rf"must be one z-scored block \[2, 4\] .* got \[2, {width}\]"):
        env.step(td)
    with pytest.raises(KeyError, match="'past_length' is missing: give the tensordict to env.reset"):
        cem(env, 2)(random_start(2))
    model.predictor.train()
    with pytest.raises(ValueError, match=r"train mode.*call its eval\(\)"):
        env.reset(random_start(2))
