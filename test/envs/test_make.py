"""make_env builds environments with the keys of the package, alone and in batches; in other processes: test_batched.py."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import SerialEnv

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs.make import GoalGymWrapper

ROOT = {"pixels", "goal_pixels", "state", "goal_state", "success", "done", "terminated", "truncated"}


def scenes(count):
    return [
        {"options": {"state": np.array([30.1 + i, 40.2]), "goal_state": np.array([150.3 + i, 60.4])}}
        for i in range(count)
    ]


def test_one_environment_has_exactly_the_keys_of_the_package():
    env = make_env("torchrl_ficreg/TwoRoom-v0")
    reset = env.reset()
    assert set(reset.keys()) == ROOT
    assert reset["success"].shape == (1,)
    assert reset["state"].dtype == torch.float64
    stepped = env.rand_step(reset)
    assert set(stepped.keys()) == ROOT | {"action", "next"}
    assert set(stepped["next"].keys()) == ROOT | {"reward"}


def test_a_batch_restores_a_scene_per_environment():
    env = make_env(num_envs=2, image_size=32)
    reset = env.reset(list_of_kwargs=scenes(2))
    assert set(reset.keys()) == ROOT
    assert reset["state"].tolist() == [[30.1, 40.2], [31.1, 40.2]]
    assert reset["goal_state"].tolist() == [[150.3, 60.4], [151.3, 60.4]]
    right = reset.set("action", torch.tensor([[1.0, 0.0], [0.5, 0.0]]))
    assert env.step(right)["next", "state"].tolist() == [[35.1, 40.2], [33.6, 40.2]]


def test_success_terminates_only_if_asked():
    near = {"state": [60.0, 112.0], "goal_state": [79.0, 112.0]}
    for terminate in (True, False):
        env = make_env(terminate_on_success=terminate)
        after = env.step(env.reset(options=near).set("action", torch.tensor([1.0, 0.0])))["next"]
        assert after["success"].item()
        assert after["reward"].item() == 1
        assert after["terminated"].item() is terminate
        assert after["done"].item() is terminate


@pytest.mark.parametrize(("limit", "length"), [(7, 7), (None, 120)])
def test_there_is_no_step_limit_unless_one_is_given(limit, length):
    env = make_env(max_episode_steps=limit, terminate_on_success=False, image_size=8)
    rollout = env.rollout(120)
    assert len(rollout) == length
    assert rollout["next", "truncated"].any().item() is (limit is not None)


def test_the_seed_fixes_the_scenes_and_each_environment_has_its_own():
    first, second, other = (make_env(num_envs=3, image_size=8, seed=seed).reset()["state"] for seed in (5, 5, 6))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert len(first.unique(dim=0)) == 3


def test_environment_arguments_arrive():
    env = make_env(collision="endpoint")
    thrown = env.step(env.reset(options={"state": [111.0, 64.0]}).set("action", torch.tensor([0.0, 1.0])))
    assert thrown["next", "state"].tolist() == [99.5, 69.0]
    assert isinstance(make_env(num_envs=2), SerialEnv)
    assert not make_env(num_envs=1, num_workers=1).batch_size


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match=r"unknown environment 'three_room': choose one of \[.*'two_room'.*\]"):
        make_env("three_room")
    with pytest.raises(ValueError, match="num_envs must be at least 1"):
        make_env(num_envs=0)
    for number in (0, 5):
        with pytest.raises(ValueError, match=rf"num_workers must be None or in 1..num_envs \(4\), got {number}"):
            make_env(num_envs=4, num_workers=number)
    with pytest.raises(ValueError, match="max_episode_steps must be at least 1"):
        make_env(max_episode_steps=0)
    with pytest.raises(TypeError, match="expected a PixelGoalEnv, got CartPoleEnv"):
        GoalGymWrapper(gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize("name", ["num_envs", "num_workers", "seed", "max_episode_steps"])
@pytest.mark.parametrize("value", [True, 2.0, "2"])
def test_numbers_of_another_type_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be an integer, got"):
        make_env("two_room", **{name: value})
