"""The arm as an environment: exact restoring, the published end of an action, no end by time, errors."""

from __future__ import annotations

import importlib.util

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs.utils import check_env_specs

from torchrl_ficreg.envs import collect_episodes, make_env
from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.reacher import physics, ReacherEnv

for name in ("mujoco", "dm_control"):
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: pip install 'torchrl_ficreg[envs]'", allow_module_level=True)

needs_gl = pytest.mark.skipif(not gl_works(), reason="no GL here: apt-get install libegl1 libgl1")
REST = [0.0, 0.0, 0.0, 0.0]


class BlindReacher(ReacherEnv):
    """The arm without pictures: what does not depend on them is tested faster, and where GL is missing."""

    def _draw(self, state):
        return np.zeros((3, self.image_size, self.image_size), np.uint8)


@pytest.fixture
def blind():
    return BlindReacher(image_size=2)


def start(env, state, goal):
    return env.reset(options={"state": state, "goal_state": goal})


@needs_gl
def test_it_passes_gymnasiums_checker():
    env = ReacherEnv(image_size=16)
    with pytest.warns(UserWarning, match="infinity"):  # the shoulder winds without limit
        check_env(env, skip_render_check=True)
    env.close()


@needs_gl
@pytest.mark.parametrize("count", [1, 2])
def test_it_meets_torchrls_specs(count):
    env = make_env("reacher", num_envs=count, image_size=16, seed=0)
    check_env_specs(env)
    env.close()


@needs_gl
def test_several_processes_step_it_as_one_does():
    actions = torch.rand(5, 2, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    scenes = [{"options": {"state": [i, 0.5, 1.0, 0.0], "goal_state": REST}} for i in (1.0, 2.0)]
    ends = []
    for workers in (None, 2):
        env = make_env("reacher", num_envs=2, num_workers=workers, image_size=16)
        td = env.reset(list_of_kwargs=scenes)
        for action in actions:
            td = env.step_mdp(env.step(td.set("action", action)))
        ends.append(td.clone())
        env.close()
    for key in ("pixels", "goal_pixels", "state"):
        assert torch.equal(ends[0][key], ends[1][key]), key


def test_a_restored_state_is_the_same_bits_and_so_is_what_follows(blind):
    """State, 50 actions, state: twice. The second time from a simulator that has been elsewhere."""
    rng = np.random.default_rng(0)
    state = np.array([17.3, 2.85, -4.0, 5.5])  # wound up, on the wrist's stop, moving into it
    actions = rng.uniform(-1, 1, (50, 2))
    runs = []
    for _ in range(2):
        observation, _ = start(blind, state, REST)
        assert observation["state"].tobytes() == state.tobytes()
        runs.append([blind.step(action)[0]["state"] for action in actions])
    assert np.array(runs[0]).tobytes() == np.array(runs[1]).tobytes()


def test_any_recorded_state_and_action_give_the_next_state_bit_for_bit(blind):
    """The state is all there is: neither the solver nor the clock remembers anything else."""
    rng = np.random.default_rng(1)
    other = BlindReacher(image_size=2)
    before = start(blind, [0.0, 2.7, 0.0, 6.0], REST)[0]["state"]
    stops = 0
    for _ in range(200):
        action = rng.uniform(-1, 1, 2)
        start(other, before, REST)
        after = blind.step(action)[0]["state"]
        assert other.step(action)[0]["state"].tobytes() == after.tobytes()
        stops += abs(after[1]) > physics.WRIST_LIMIT
        before = after
    assert stops > 0


def test_an_action_lasts_two_control_steps(blind):
    """From rest and unhindered: as dm_control's file integrates, 2 semi-implicit Euler steps of 0.02 s."""
    start(blind, REST, [2.0, 2.0, 0.0, 0.0])
    blind.step(np.array([1.0, 0.0]))
    assert blind._data.time == pytest.approx(0.04)


def test_there_is_no_end_by_time(blind):
    """600 actions are 1200 control steps; after 1000 dm_control would have put the arm elsewhere, unasked."""
    start(blind, REST, [1.0, 2.0, 0.0, 0.0])
    states = []
    for _ in range(600):
        observation, _, terminated, truncated, _ = blind.step(np.array([1.0, 0.1]))
        assert not truncated
        states.append(observation["state"])
    jumps = np.abs(np.diff(np.array(states)[:, 0]))
    assert jumps.max() < 0.04 * 8  # rad, at less than 8 rad/s
    assert states[-1][0] > 90  # many turns, all counted


def find_pass(env):
    """A state from which one action's first control step is within the goal and its second is not."""
    state = np.array([0.0, 0.0, 4.0, 0.0])
    env._set_state(state)
    env._goal_state = None
    env._mujoco.mj_step(env._model, env._data)
    goal = env._get_state() - [0.045, 0.0, 0.0, 0.0]  # 0.08 rad per control step: passed at the second
    return state, [*goal[:2], 0.0, 0.0]


def test_the_action_that_reaches_the_goal_ends_there(blind):
    """As published: success is tested after each control step, and the second is then not taken."""
    state, goal = find_pass(blind)
    start(blind, state, goal)
    _, reward, terminated, _, info = blind.step(np.zeros(2))
    assert (reward, terminated, info["success"].item()) == (1.0, True, True)
    assert blind._data.time == pytest.approx(0.02)
    _, _, _, _, info = blind.step(np.zeros(2))  # a second one, for who goes on, is a whole one
    assert blind._data.time == pytest.approx(0.06)
    assert not info["success"].item()


def test_whole_actions_may_be_asked_for():
    blind = BlindReacher(image_size=2, stop_within_action=False)
    state, goal = find_pass(blind)
    start(blind, state, goal)
    _, _, terminated, _, info = blind.step(np.zeros(2))
    assert blind._data.time == pytest.approx(0.04)
    assert not terminated
    assert not info["success"].item()


def test_each_episode_may_end_an_action_once(blind):
    state, goal = find_pass(blind)
    for _ in range(2):
        start(blind, state, goal)
        blind.step(np.zeros(2))
        assert blind._data.time == pytest.approx(0.02)


@pytest.mark.parametrize("wrap", [True, False])
def test_a_shoulder_one_turn_away_is_at_the_goal_unless_the_published_rule_is_asked_for(wrap):
    env = BlindReacher(image_size=2, wrap=wrap)
    _, info = start(env, [0.3 + 2 * np.pi, 0.2, 0.0, 0.0], [0.3, 0.2, 0.0, 0.0])
    assert info["success"].item() is wrap


def test_the_seed_fixes_start_and_goal_which_are_at_rest(blind):
    first, second, other = (blind.reset(seed=seed)[0] for seed in (3, 3, 4))
    for key in ("state", "goal_state"):
        assert np.array_equal(first[key], second[key])
        assert not np.array_equal(first[key], other[key])
        assert not first[key][2:].any()
    assert not np.array_equal(first["state"], first["goal_state"])


def test_what_recordings_reach_is_legal_and_more_is_not(blind):
    for wrist in (physics.WRIST_LIMIT + 0.16, -physics.WRIST_LIMIT - 0.16):
        observation, _ = start(blind, [-250.0, wrist, 30.0, -30.0], REST)
        assert blind.observation_space["state"].contains(observation["state"])
    with pytest.raises(ValueError, match=r"option 'state' .* is not legal: the wrist's stop at \+-2.7925 rad"):
        start(blind, [0.0, 3.1, 0.0, 0.0], REST)
    with pytest.raises(ValueError, match="option 'goal_state' .* is not legal"):
        start(blind, REST, [0.0, -3.1, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"must have shape \(4,\), got \(2,\)"):
        blind.reset(options={"state": [0.0, 0.0]})


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="shadow_size must be a positive integer, got 0"):
        ReacherEnv(shadow_size=0)
    with pytest.raises(ValueError, match="image_size must be a positive integer"):
        ReacherEnv(image_size=0)


@needs_gl
def test_gymnasium_makes_it_by_its_id():
    env = gymnasium.make("torchrl_ficreg/Reacher-v0", image_size=16)
    assert isinstance(env.unwrapped, ReacherEnv)
    assert env.reset(seed=0)[0]["pixels"].shape == (3, 16, 16)
    env.close()


@needs_gl
def test_recorded_episodes_are_whole_and_their_frames_are_those_of_their_states():
    """Replaying the recorded actions gives the recorded states, and the states give the recorded frames."""
    settings = {"image_size": 16, "max_steps": 12, "stop_at_success": False}
    (episode,) = collect_episodes(
        "reacher", 1, num_workers=0, env_kwargs={"stop_within_action": False}, **settings
    )
    assert episode["pixels"].shape == (13, 3, 16, 16)
    assert episode["state"].shape == (13, 4)
    env = ReacherEnv(image_size=16, stop_within_action=False)
    observation, _ = start(env, episode["state"][0], REST)
    for t, action in enumerate(episode["action"][:-1]):
        observation = env.step(action)[0]
        assert observation["state"].tobytes() == episode["state"][t + 1].tobytes()
        assert np.array_equal(observation["pixels"], episode["pixels"][t + 1])
    env.close()
