"""The goal protocol, shown on TwoRoom: exact restoration, refusals, rewards, and Gymnasium's own checks."""

from __future__ import annotations

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import torchrl_ficreg.envs  # noqa: F401  registers the ids
from torchrl_ficreg.envs.two_room.env import TwoRoomEnv

START = np.array([60.123456789, 112.987654321])
GOAL = np.array([164.0, 112.0])
BOTH = {"state": START, "goal_state": GOAL}


def roll(env, actions):
    return [env.step(action) for action in actions]


@pytest.mark.filterwarnings("ignore:.*render modes.*")
@pytest.mark.parametrize("collision", ["swept", "endpoint"])
def test_gymnasium_accepts_the_environment(collision):
    check_env(gymnasium.make("torchrl_ficreg/TwoRoom-v0", collision=collision).unwrapped)


def test_the_registered_id_truncates_after_100_steps_and_the_class_never():
    env = gymnasium.make("torchrl_ficreg/TwoRoom-v0", terminate_on_success=False)
    env.reset(seed=0)
    truncated = [outcome[3] for outcome in roll(env, [np.zeros(2, np.float32)] * 100)]
    assert truncated == [False] * 99 + [True]
    assert not env.unwrapped.step(np.zeros(2))[3]


def test_the_observation_holds_two_pictures_and_two_states():
    observation, info = TwoRoomEnv(image_size=48).reset(options=BOTH)
    assert {key: (value.shape, value.dtype.name) for key, value in observation.items()} == {
        "pixels": ((3, 48, 48), "uint8"),
        "goal_pixels": ((3, 48, 48), "uint8"),
        "state": ((2,), "float64"),
        "goal_state": ((2,), "float64"),
    }
    assert info["success"].shape == (1,)
    assert info["success"].dtype == bool


def test_reset_restores_states_bit_for_bit_and_the_future_with_them():
    """The same 50 actions from the same state give the same bits, in another environment and after another episode."""
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 2))
    futures = []
    for env in (TwoRoomEnv(), TwoRoomEnv()):
        for _ in range(2):
            observation, _ = env.reset(options=BOTH)
            assert observation["state"].tobytes() == START.tobytes()
            assert observation["goal_state"].tobytes() == GOAL.tobytes()
            futures.append([outcome[0] for outcome in roll(env, actions)])
    for other in futures[1:]:
        for ours, theirs in zip(futures[0], other, strict=True):
            assert all(ours[key].tobytes() == theirs[key].tobytes() for key in ours)


def test_any_visited_state_can_be_restored():
    """Taking the state out halfway and putting it into a fresh environment continues the episode exactly."""
    actions = np.random.default_rng(1).uniform(-1, 1, (60, 2)) + [0.4, -0.2]
    env, fresh = TwoRoomEnv(), TwoRoomEnv()
    env.reset(options=BOTH)
    middle = roll(env, actions[:30])[-1][0]
    restored, _ = fresh.reset(options={"state": middle["state"], "goal_state": middle["goal_state"]})
    assert all(restored[key].tobytes() == middle[key].tobytes() for key in middle)
    end, fresh_end = roll(env, actions[30:])[-1][0], roll(fresh, actions[30:])[-1][0]
    assert all(end[key].tobytes() == fresh_end[key].tobytes() for key in end)


def test_the_goal_picture_is_the_picture_seen_at_the_goal():
    env = TwoRoomEnv()
    goal_picture = env.reset(options=BOTH)[0]["goal_pixels"]
    assert np.array_equal(env.reset(options={"state": GOAL, "goal_state": START})[0]["pixels"], goal_picture)


def test_success_is_rewarded_reported_at_reset_too_and_ends_the_episode_if_asked():
    near = {"state": [60.0, 112.0], "goal_state": [79.0, 112.0]}
    for terminate in (True, False):
        env = TwoRoomEnv(terminate_on_success=terminate)
        assert not env.reset(options=near)[1]["success"].item()
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0]))  # 14 px left
        assert (reward, terminated, truncated, info["success"].item()) == (1.0, terminate, False, True)
        _, reward, terminated, _, info = env.step(np.array([-1.0, 0.0]))  # 19 px again: success is not sticky
        assert (reward, terminated, info["success"].item()) == (0.0, False, False)
    assert env.reset(options={"state": GOAL, "goal_state": GOAL})[1]["success"].item()


def test_seeds_fix_the_tasks_and_every_reset_draws_a_new_one():
    first, second = TwoRoomEnv(), TwoRoomEnv()
    ours = [first.reset(seed=7)[0], first.reset()[0]]
    theirs = [second.reset(seed=7)[0], second.reset()[0]]
    for one, other in zip(ours, theirs, strict=True):
        assert one["state"].tobytes() == other["state"].tobytes()
        assert one["goal_state"].tobytes() == other["goal_state"].tobytes()
    assert not np.array_equal(ours[0]["state"], ours[1]["state"])


def test_drawn_tasks_lead_through_the_door_at_least_25_steps_away():
    """Published data: the target is in the other room, at least 125 px away through the door."""
    env, door = TwoRoomEnv(image_size=8), np.array([112.0, 49.0])
    for seed in range(200):
        observation, _ = env.reset(seed=seed)
        start, goal = observation["state"], observation["goal_state"]
        assert (start[0] < 100 and goal[0] > 124) or (start[0] > 124 and goal[0] < 100)
        assert np.linalg.norm(start - door) + np.linalg.norm(door - goal) >= 125
        assert min(start.min(), goal.min()) >= 21
        assert max(start.max(), goal.max()) <= 203


def test_writing_into_arrays_from_outside_changes_nothing_inside():
    options = {"state": START.copy(), "goal_state": GOAL.copy()}
    env, untouched = TwoRoomEnv(), TwoRoomEnv()
    observation, _ = env.reset(options=options)
    untouched.reset(options=BOTH)
    for array in (*observation.values(), *options.values()):
        array[...] = 33
    ours, theirs = env.step(np.ones(2))[0], untouched.step(np.ones(2))[0]
    assert all(np.array_equal(ours[key], theirs[key]) for key in ours)


def test_actions_are_left_as_they_are():
    env, action = TwoRoomEnv(), np.array([3.0, -0.5], np.float32)
    env.reset(seed=0)
    env.step(action)
    assert action.tolist() == [3.0, -0.5]


def test_render_gives_the_picture_with_channels_last():
    env = TwoRoomEnv()
    observation, _ = env.reset(seed=0)
    assert np.array_equal(env.render().transpose(2, 0, 1), observation["pixels"])
    silent = TwoRoomEnv(render_mode=None)
    silent.reset(seed=0)
    assert silent.render() is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": [60.0, 112.0, 0.0]}, r"'state' must have shape \(2,\), got \(3,\)"),
        ({"goal_state": [np.nan, 60.0]}, "'goal_state' must be finite"),
        ({"state": [112.0, 150.0]}, "inside the wall"),
        ({"goal_state": [3.0, 150.0]}, "is not legal"),
        ({"target": [60.0, 60.0]}, r"unknown reset options \['target'\]"),
    ],
)
def test_a_bad_reset_says_what_is_wrong_and_leaves_the_episode_running(options, message):
    env = TwoRoomEnv()
    env.reset(options=BOTH)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    assert env.step(np.zeros(2))[0]["state"].tobytes() == START.tobytes()


@pytest.mark.parametrize(
    ("action", "message"), [(np.zeros(3), r"must be \(2,\), got \(3,\)"), (np.array([np.nan, 0]), "must be finite")]
)
def test_a_bad_action_is_refused(action, message):
    env = TwoRoomEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_bad_constructor_arguments_are_refused_and_a_step_needs_a_reset():
    with pytest.raises(ValueError, match="image_size must be a positive integer"):
        TwoRoomEnv(image_size=0)
    with pytest.raises(ValueError, match="render_mode must be"):
        TwoRoomEnv(render_mode="human")
    with pytest.raises(ValueError, match="collision must be one of"):
        TwoRoomEnv(collision="bounce")
    with pytest.raises(gymnasium.error.ResetNeeded):
        TwoRoomEnv().step(np.zeros(2))


def test_importing_the_environments_loads_no_simulator():
    """The ids are registered by name only. TorchRL itself loads MuJoCo while it looks for mujoco.mjx."""
    heavy = ["pymunk", "mujoco", "dm_control", "matplotlib", "h5py", "wandb"]
    script = (
        "import sys, gymnasium, torchrl.envs; theirs = set(sys.modules); import torchrl_ficreg.envs; "
        "assert 'torchrl_ficreg/TwoRoom-v0' in gymnasium.registry; "
        f"sys.exit([name for name in {heavy} if name in sys.modules and name not in theirs] or None)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
