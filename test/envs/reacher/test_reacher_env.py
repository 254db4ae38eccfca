"""What ReacherEnv adds to the protocol of all environments: the published end of an action, and no time limit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from simulators import require_simulator

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs.reacher import ReacherEnv

require_simulator("reacher", pictures=False)
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


def test_several_processes_step_it_as_one_does():
    require_simulator("reacher")
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


@pytest.mark.parametrize("stop", [True, False])
def test_the_action_that_reaches_the_goal_ends_there_unless_actions_are_left_whole(stop):
    """As published: success is tested after each of two control steps of 0.02 s, and the second is then not taken."""
    env = BlindReacher(image_size=2, stop_within_action=stop)
    state, goal = find_pass(env)
    for _ in range(2):  # in each episode
        start(env, state, goal)
        _, reward, terminated, _, info = env.step(np.zeros(2))
        assert (reward, terminated, info["success"].item()) == (float(stop), stop, stop)
        assert env._data.time == pytest.approx(0.02 if stop else 0.04)
        assert not env.step(np.zeros(2))[4]["success"].item()  # the next one is not shortened
        assert env._data.time == pytest.approx(0.06 if stop else 0.08)


@pytest.mark.parametrize("wrap", [True, False])
def test_a_shoulder_one_turn_away_is_at_the_goal_unless_the_published_rule_is_asked_for(wrap):
    env = BlindReacher(image_size=2, wrap=wrap)
    _, info = start(env, [0.3 + 2 * np.pi, 0.2, 0.0, 0.0], [0.3, 0.2, 0.0, 0.0])
    assert info["success"].item() is wrap
