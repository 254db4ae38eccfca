"""Every environment is found by both of its names, and its expert keeps the Expert protocol."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from torchrl_ficreg.envs import ENVIRONMENTS, PixelGoalEnv
from torchrl_ficreg.envs._gl import gl_works
from torchrl_ficreg.envs.registry import find_entry, register_all

NEEDED = {"push_t": "pymunk", "reacher": "dm_control", "cube": "ogbench"}
KINDS = {"reacher": [{"kind": "random"}, {"kind": "reach"}, {"kind": "goal"}]}
EXPERTS = [(name, kwargs) for name in sorted(ENVIRONMENTS) for kwargs in KINDS.get(name, [{}])]


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
def test_both_names_find_the_environment(name):
    entry = ENVIRONMENTS[name]
    register_all()  # a second time
    assert find_entry(name) is find_entry(entry.gym_id) is entry
    assert gymnasium.spec(entry.gym_id).entry_point == entry.entry_point


@pytest.mark.parametrize(("name", "kwargs"), EXPERTS)
def test_an_expert_is_fixed_by_its_generator_and_leaves_its_environment_and_arguments_alone(name, kwargs):
    if name in NEEDED:
        pytest.importorskip(NEEDED[name])
    if name in ("reacher", "cube") and not gl_works():
        pytest.skip("no GL here: apt-get install libegl1 libgl1")
    entry = ENVIRONMENTS[name]
    env, asked = (entry.load_env()(image_size=8, terminate_on_success=False) for _ in range(2))
    assert isinstance(env, PixelGoalEnv)
    asked.reset(seed=4)
    before = asked._get_state()
    runs = []
    for seed in (5, 5, 6):
        expert = entry.load_expert()(rng=np.random.default_rng(seed), env=asked, **kwargs)
        observation, actions = env.reset(seed=3)[0], []
        for _ in range(30):
            given = [observation[key].copy() for key in ("state", "goal_state")]
            action = expert(*given)
            assert all(np.array_equal(array, observation[key]) for array, key in zip(given, ("state", "goal_state")))
            assert action.shape == env.action_space.shape and action.dtype == np.float32 and np.abs(action).max() <= 1
            actions.append(action.copy())
            observation = env.step(actions[-1])[0]
            action[:] = np.nan  # the expert does not keep what it returned
        runs.append(np.stack(actions))
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])
    assert np.array_equal(asked._get_state(), before)
