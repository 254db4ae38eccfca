"""The protocol of PixelGoalEnv, kept by all environments: exact restoration, goals, seeds, errors, Gymnasium's checks."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from simulators import assert_same, NEEDED, require_simulator
from torchrl.envs.utils import check_env_specs

from torchrl_ficreg.envs import ENVIRONMENTS, make_env
from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.two_room.env import TwoRoomEnv

START = np.array([60.123456789, 112.987654321])
GOAL = np.array([164.0, 112.0])
BOTH = {"state": START, "goal_state": GOAL}
SIZE = 16
STATES = {
    "two_room": (START, GOAL),
    # the disc beside the bar of the T
    "push_t": ([190.0, 300.0, 256.0, 300.0, 0.5, 20.0, -30.0], [100.0, 100.0, 300.0, 260.0, 0.1, 0.0, 0.0]),
    # several turns, on the wrist's stop and moving into it
    "reacher": ([17.3, 2.85, -4.0, 5.5], [0.3, 0.2, 0.0, 0.0]),
}
SETTINGS = {"push_t": [{}, {"success_on": "block", "draw_goal": False}, {"legacy_restore": True}]}


class Case:
    """One environment, with a start and a goal."""

    def __init__(self, name):
        require_simulator(name)
        self.name = name
        if name == "cube":
            from torchrl_ficreg.envs.cube import CubeArm

            arm = CubeArm()
            self.start = arm.resting(arm_yaw=0.3, cube_position=[0.4, 0.1], cube_yaw=0.2)
            self.goal = arm.resting(arm_yaw=0.0, cube_position=[0.5, -0.1], cube_yaw=1.0)
        else:
            self.start, self.goal = map(np.array, STATES[name])
        self.options = {"state": self.start, "goal_state": self.goal}

    def build(self, **kwargs):
        return ENVIRONMENTS[self.name].load_env()(image_size=SIZE, **{"terminate_on_success": False, **kwargs})

    def actions(self, count):
        size = self.build().action_space.shape
        return np.random.default_rng(0).uniform(-1.2, 1.2, (count, *size)).astype(np.float32)


@pytest.fixture(params=sorted(ENVIRONMENTS))
def case(request):
    return Case(request.param)


def roll(env, actions):
    return [env.step(action) for action in actions]


def test_gymnasium_accepts_it(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(render modes|infinity).*")
        for settings in SETTINGS.get(case.name, [{}]):
            check_env(case.build(terminate_on_success=True, **settings))


def test_torchrl_accepts_it_and_a_batch_steps_as_its_environments_do_alone(case):
    check_env_specs(make_env(case.name, image_size=SIZE))
    batch = make_env(case.name, 2, image_size=SIZE, terminate_on_success=False)
    check_env_specs(batch)
    swapped = {"state": case.goal, "goal_state": case.start}
    many = batch.reset(list_of_kwargs=[{"options": case.options}, {"options": swapped}])
    alone = case.build()
    alone.reset(options=swapped)
    for action in case.actions(10).reshape(5, 2, -1):
        many = batch.step_mdp(batch.step(many.set("action", torch.from_numpy(action))))
        observation = alone.step(action[1])[0]
        assert_same(observation, {key: many[key][1] for key in observation})


def test_the_same_state_and_actions_give_the_same_bits(case):
    """After another episode and in another environment; reset restores the states themselves bit for bit."""
    actions, futures = case.actions(50), []
    env = case.build()
    for one in (env, env, case.build()):
        observation, _ = one.reset(options=case.options)
        assert_same(case.options, {key: observation[key] for key in case.options})
        futures.append([outcome[0] for outcome in roll(one, actions)])
    if case.name != "cube":  # which nothing touches
        assert (np.ptp([observation["state"] for observation in futures[0]], axis=0) > 0).all()
    for other in futures[1:]:
        for ours, theirs in zip(futures[0], other, strict=True):
            assert_same(ours, theirs)


def test_any_visited_state_is_restored_with_its_picture_and_its_future(case):
    """Except for PushT, whose solver caches contacts that are not part of the published state."""
    env, fresh = case.build(), case.build()
    env.reset(options=case.options)
    outcomes = [outcome[0] for outcome in roll(env, case.actions(20))]
    for middle in (6, 13):
        restored, _ = fresh.reset(options={key: outcomes[middle][key] for key in case.options})
        assert_same(outcomes[middle], restored)
        if case.name != "push_t":
            assert_same(outcomes[-1], roll(fresh, case.actions(20)[middle + 1 :])[-1][0])


def test_drawing_does_not_change_the_simulation(case):
    quiet, drawn = case.build(), case.build()
    for env in (quiet, drawn):
        env.reset(options=case.options)
    for action in case.actions(5):
        drawn.render()
        drawn._draw(case.goal)
        assert_same(quiet.step(action)[0], drawn.step(action)[0])


def test_the_goal_picture_is_the_picture_at_the_goal_where_success_is_reported(case):
    env = case.build()
    goal_picture = env.reset(options=case.options)[0]["goal_pixels"]
    observation, info = env.reset(options={"state": case.goal, "goal_state": case.goal})
    assert np.array_equal(observation["pixels"], goal_picture)
    assert np.array_equal(env.render().transpose(2, 0, 1), goal_picture)
    assert info["success"].tolist() == [True]


def test_seeds_fix_the_tasks_and_every_reset_draws_a_new_one(case):
    first, second = case.build(), case.build()
    ours = [first.reset(seed=7)[0], first.reset()[0]]
    np.random.seed(0)  # the published cube would draw from here
    theirs = [second.reset(seed=7)[0], second.reset()[0]]
    for one, other in zip(ours, theirs, strict=True):
        assert_same(one, other)
    for other in (ours[1], first.reset(seed=8)[0]):
        assert not np.array_equal(ours[0]["state"], other["state"])
    assert not np.array_equal(ours[0]["state"], ours[0]["goal_state"])


def test_callers_may_write_into_the_arrays_that_they_pass_and_receive(case):
    options, actions = {key: state.copy() for key, state in case.options.items()}, case.actions(1)
    env, untouched = case.build(), case.build()
    observation, _ = env.reset(options=options)
    untouched.reset(options=case.options)
    for array in (*observation.values(), *options.values()):
        array[...] = 33
    assert_same(env.step(actions[0])[0], untouched.step(actions[0])[0])
    assert np.array_equal(actions, case.actions(1))


@pytest.mark.parametrize(
    ("value", "extra", "message"),
    [
        (1e300, 0, "action must be within"),
        (-1e3, 0, "action must be within"),
        (np.nan, 0, "must be finite"),
        (0.0, 1, r"must be \(.,\), got \(.,\)"),
    ],
)
def test_an_action_that_cannot_be_is_refused_and_changes_nothing(case, value, extra, message):
    env = case.build()
    env.reset(options=case.options)
    with pytest.raises(ValueError, match=message):
        env.step(np.full(env.action_space.shape[0] + extra, value))
    assert np.array_equal(env._get_state(), case.start)


def push_t_with(index, value):
    state = np.array(STATES["push_t"][1])
    state[index] = value
    return state


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("two_room", {"state": [60.0, 112.0, 0.0]}, r"'state' must have shape \(2,\), got \(3,\)"),
        ("two_room", {"goal_state": [np.nan, 60.0]}, "'goal_state' must be finite"),
        ("two_room", {"state": [112.0, 150.0]}, "inside the wall"),
        ("two_room", {"goal_state": [3.0, 150.0]}, "is not legal"),
        ("two_room", {"target": [60.0, 60.0]}, r"unknown reset options \['target'\]"),
        ("two_room", {"draw_every": 0}, "'draw_every' must be a positive integer, got 0"),
        ("push_t", {"goal_state": push_t_with(4, -0.1)}, r"the angle, state\[4\], leaves \[0, 2 pi\): take it modulo 2 pi"),
        ("push_t", {"goal_state": push_t_with(4, 6.3)}, r"the angle, state\[4\], leaves"),
        ("push_t", {"state": push_t_with(0, -10_001.0)}, r"a coordinate or a velocity leaves \[-10000, 10000\]"),
        ("push_t", {"state": push_t_with(6, 10_001.0)}, "a coordinate or a velocity leaves"),
        ("push_t", {"state": np.zeros(5)}, r"must have shape \(7,\), got \(5,\)"),
        ("reacher", {"state": [0.0, 3.1, 0.0, 0.0]}, r"option 'state' .* is not legal: the wrist's stop at \+-2.7925 rad"),
        ("reacher", {"goal_state": [0.0, -3.1, 0.0, 0.0]}, "option 'goal_state' .* is not legal"),
        ("reacher", {"state": [0.0, 0.0]}, r"must have shape \(4,\), got \(2,\)"),
        ("cube", {"state": np.zeros(28)}, r"must have shape \(41,\), got \(28,\)"),
        ("cube", {"state": np.zeros(41)}, "quaternion of the cube, of length 1, but have length 0"),
        ("cube", {"state": np.eye(41)[17] - 0.1 * np.eye(41)[16]}, "the cube is below the floor"),
    ],
)
def test_a_bad_reset_says_what_is_wrong_and_leaves_the_episode_running(name, options, message):
    case = Case(name)
    env = case.build()
    env.reset(options=case.options)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    assert np.array_equal(env._get_state(), case.start)


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("push_t", [8590.0, 8590.0, 200.0, 200.0, 0.0, 500.0, 500.0]),  # 200 steps at full speed: 200 * 40.7 + 450 px
        ("push_t", push_t_with(4, np.float32(np.nextafter(2 * np.pi, 0)))),  # a recorded angle that rounding made too large
        *[("reacher", [-250.0, wrist, 30.0, -30.0]) for wrist in (2.95, -2.95)],  # pushed into the stop
    ],
)
def test_states_of_recordings_are_legal(name, state):
    env = Case(name).build()
    observation, _ = env.reset(options={"state": state})
    assert env.observation_space.contains(observation) and observation["state"].tolist() == list(state)


def test_the_registered_id_truncates_and_the_class_does_not():
    env = gymnasium.make("torchrl_ficreg/TwoRoom-v0", terminate_on_success=False)
    env.reset(seed=0)
    truncated = [outcome[3] for outcome in roll(env, [np.zeros(2, np.float32)] * 100)]
    assert truncated == [False] * 99 + [True] and not env.unwrapped.step(np.zeros(2))[3]
    with pytest.raises(gymnasium.error.ResetNeeded):
        TwoRoomEnv().step(np.zeros(2))


def test_the_observation_holds_two_pictures_and_two_states():
    observation, info = TwoRoomEnv(image_size=48).reset(options=BOTH)
    assert {key: (value.shape, value.dtype.name) for key, value in observation.items()} == {
        "pixels": ((3, 48, 48), "uint8"),
        "goal_pixels": ((3, 48, 48), "uint8"),
        "state": ((2,), "float64"),
        "goal_state": ((2,), "float64"),
    }
    assert info["success"].shape == (1,) and info["success"].dtype == bool
    silent = TwoRoomEnv(render_mode=None)
    silent.reset(seed=0)
    assert silent.render() is None


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


def test_drawn_tasks_lead_through_the_door_at_least_25_steps_away():
    """Published: the target is in the other room, at least 125 px away through the door."""
    env, door = TwoRoomEnv(image_size=8), np.array([112.0, 49.0])
    for seed in range(200):
        observation, _ = env.reset(seed=seed)
        start, goal = observation["state"], observation["goal_state"]
        assert (start[0] < 100 and goal[0] > 124) or (start[0] > 124 and goal[0] < 100)
        assert np.linalg.norm(start - door) + np.linalg.norm(door - goal) >= 125
        assert min(start.min(), goal.min()) >= 21 and max(start.max(), goal.max()) <= 203


@pytest.mark.parametrize("integer", [int, np.int64])
def test_sizes_seeds_and_steps_may_be_integers_of_numpy(integer):
    env = TwoRoomEnv(image_size=integer(16))
    assert type(env.image_size) is int and env.reset(seed=0)[0]["pixels"].shape == (3, 16, 16)
    options = {"draw_every": integer(2)}
    assert_same(env.reset(seed=integer(3), options=options)[0], env.reset(seed=3)[0])


def test_pictures_are_drawn_every_few_steps_on_demand_and_repeated_between():
    """All else is as without the option, which ends with the episode."""
    whole, sparse = TwoRoomEnv(image_size=16, terminate_on_success=False), TwoRoomEnv(image_size=16)
    every = [whole.reset(options=BOTH)[0], *(whole.step(np.ones(2))[0] for _ in range(7))]
    observation = sparse.reset(options={**BOTH, "draw_every": 3})[0]
    for step, expected in enumerate(every):
        assert_same(observation, {**expected, "pixels": every[step - step % 3]["pixels"]})
        observation["pixels"][:] = 0  # changes no later picture
        observation = sparse.step(np.ones(2))[0]
    sparse.reset(options=BOTH)
    assert_same(sparse.step(np.ones(2))[0], every[1])


LEFT_OPEN = """
import sys
import gymnasium, torchrl.envs

theirs = set(sys.modules)  # TorchRL loads MuJoCo while it looks for mujoco.mjx
import torchrl_ficreg.envs
from torchrl_ficreg.envs import ENVIRONMENTS, make_env

if __name__ == "__main__":
    assert all(entry.gym_id in gymnasium.registry for entry in ENVIRONMENTS.values())
    from torchrl_ficreg import FICRegLoss
    print([name for name in {heavy} if name in sys.modules and name not in theirs])
    for name, num_envs, num_workers in {cases}:
        env = make_env(name, num_envs=num_envs, num_workers=num_workers, image_size=8)
        env.rollout(2)
        env.itself = env  # a cycle, so that only the end of the interpreter frees it
        print(name)
"""


@pytest.mark.parametrize("num_workers", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_importing_loads_no_simulator_and_environments_left_open_are_silent_at_exit(num_workers, tmp_path):
    """Of environments and of losses. The ids are registered by name. At exit, pymunk and GL would print exceptions of their destructors."""
    heavy = "pymunk mujoco dm_control ogbench pygame h5py hdf5plugin lance safetensors PIL imageio matplotlib wandb".split()
    heavy += ["transformers"]
    names = [name for name in ENVIRONMENTS if name not in NEEDED or importlib.util.find_spec(NEEDED[name])]
    names = [name for name in names if name in ("two_room", "push_t") or gl_works()]
    script = tmp_path / "left_open.py"
    cases = [(name, num_workers or 1, num_workers) for name in names]
    script.write_text(LEFT_OPEN.format(heavy=heavy, cases=cases))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    result = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment)
    assert (result.returncode, result.stderr) == (0, "") and result.stdout.splitlines() == ["[]", *names]


def test_no_public_name_hides_a_module():
    """``from torchrl_ficreg.envs.two_room import render`` is the module."""
    for package in ("", *(f".{name}" for name in ENVIRONMENTS)):
        module = importlib.import_module(f"torchrl_ficreg.envs{package}")
        assert not {info.name for info in pkgutil.iter_modules(module.__path__)} & set(module.__all__)
