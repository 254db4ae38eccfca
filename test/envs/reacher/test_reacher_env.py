"""What ReacherEnv adds to the protocol of all environments: the published end of an action, no time limit, errors."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.reacher import physics, ReacherEnv

for name in ("mujoco", "dm_control"):
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: pip install 'torchrl_ficreg[envs]'", allow_module_level=True)

needs_gl = pytest.mark.skipif(not gl_works(), reason="no GL here: apt-get install libegl1 libgl1")
REST = [0.0, 0.0, 0.0, 0.0]


class BlindReacher(ReacherEnv):
    """The arm without pictures, for claims that do not depend on them: faster, and without GL."""

    def _draw(self, state):
        return np.zeros((3, self.image_size, self.image_size), np.uint8)


@pytest.fixture
def blind():
    return BlindReacher(image_size=2)


def start(env, state, goal):
    return env.reset(options={"state": state, "goal_state": goal})


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


def test_any_recorded_state_and_action_give_the_next_state_bit_for_bit(blind):
    """There is no hidden state in the solver or the clock."""
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


def test_there_is_no_time_limit(blind):
    """600 actions are 1200 control steps; dm_control would reset the arm after 1000."""
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
    _, _, _, _, info = blind.step(np.zeros(2))  # the next one is not shortened
    assert blind._data.time == pytest.approx(0.06)
    assert not info["success"].item()


def test_actions_may_be_left_whole():
    blind = BlindReacher(image_size=2, stop_within_action=False)
    state, goal = find_pass(blind)
    start(blind, state, goal)
    _, _, terminated, _, info = blind.step(np.zeros(2))
    assert blind._data.time == pytest.approx(0.04)
    assert not terminated
    assert not info["success"].item()


def test_each_episode_ends_one_action_early(blind):
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


def test_states_of_recordings_are_legal_and_others_are_not(blind):
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
