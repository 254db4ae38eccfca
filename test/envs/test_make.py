"""make_env builds environments with the keys of the package, alone and in batches; in other processes: test_batched.py."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from torchrl.envs import SerialEnv

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs.make import GoalGymWrapper

ROOT = {"pixels", "goal_pixels", "state", "goal_state", "success", "done", "terminated", "truncated"}
INTEGERS = ("num_envs", "num_workers", "seed", "max_episode_steps")


def test_one_environment_has_exactly_the_keys_of_the_package():
    env = make_env("torchrl_ficreg/TwoRoom-v0")
    reset = env.reset()
    assert set(reset.keys()) == ROOT and reset["success"].shape == (1,)
    assert reset["state"].dtype == torch.float64
    stepped = env.rand_step(reset)
    assert set(stepped.keys()) == ROOT | {"action", "next"}
    assert set(stepped["next"].keys()) == ROOT | {"reward"}


def test_success_terminates_only_if_asked():
    near = {"state": [60.0, 112.0], "goal_state": [79.0, 112.0]}
    for terminate in (True, False):
        env = make_env(terminate_on_success=terminate)
        after = env.step(env.reset(options=near).set("action", torch.tensor([1.0, 0.0])))["next"]
        assert after["success"].item() and after["reward"].item() == 1
        assert after["terminated"].item() is terminate and after["done"].item() is terminate


@pytest.mark.parametrize(("limit", "length"), [(7, 7), (None, 120)])
def test_there_is_no_step_limit_unless_one_is_given(limit, length):
    env = make_env(max_episode_steps=limit, terminate_on_success=False, image_size=8)
    rollout = env.rollout(120)
    assert len(rollout) == length and rollout["next", "truncated"].any().item() is (limit is not None)


def test_environment_arguments_arrive():
    env = make_env(collision="endpoint")
    thrown = env.step(env.reset(options={"state": [111.0, 64.0]}).set("action", torch.tensor([0.0, 1.0])))
    assert thrown["next", "state"].tolist() == [99.5, 69.0] and isinstance(make_env(num_envs=2), SerialEnv)
    assert not make_env(num_envs=1, num_workers=1).batch_size


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"name": "three_room"}, r"unknown environment 'three_room': choose one of \[.*'two_room'.*\]"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1"),
        *[({"num_envs": 4, "num_workers": count}, rf"None or in 1..num_envs \(4\), got {count}") for count in (0, 5)],
        *[({name: value}, f"{name} must be an integer, got") for name in INTEGERS for value in (True, 2.0, "2")],
    ],
)
def test_bad_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_env(**{"name": "two_room", **kwargs})


def test_environments_of_others_are_refused():
    with pytest.raises(TypeError, match="expected a PixelGoalEnv, got CartPoleEnv"):
        GoalGymWrapper(gymnasium.make("CartPole-v1"))
