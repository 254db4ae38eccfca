"""Every environment is found by both of its names, refuses bad arguments, and its expert keeps the Expert protocol."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from simulators import require_simulator

from torchrl_ficreg.envs import ENVIRONMENTS, PixelGoalEnv
from torchrl_ficreg.envs.registry import find_entry, register_all

KINDS = {"reacher": [{"kind": "random"}, {"kind": "reach"}, {"kind": "goal"}]}
EXPERTS = [(name, kwargs) for name in sorted(ENVIRONMENTS) for kwargs in KINDS.get(name, [{}])]


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
def test_both_names_find_the_environment(name):
    entry = ENVIRONMENTS[name]
    register_all()  # a second time
    assert find_entry(name) is find_entry(entry.gym_id) is entry
    spec = gymnasium.spec(entry.gym_id)
    assert spec.entry_point == entry.entry_point and spec.max_episode_steps == (100 if name == "two_room" else 200)


@pytest.mark.parametrize(
    ("name", "part", "kwargs", "message"),
    [
        *[(name, "env", {"image_size": size}, "image_size must be a positive integer")
          for name in ENVIRONMENTS for size in (0, True, 8.0, "8")],
        ("two_room", "env", {"render_mode": "human"}, "render_mode must be"),
        ("two_room", "env", {"collision": "bounce"}, "collision must be one of"),
        ("push_t", "env", {"success_on": "agent"}, r"success_on must be one of \('state', 'block'\), got 'agent'"),
        ("reacher", "env", {"shadow_size": 0}, "shadow_size must be a positive integer, got 0"),
        ("cube", "env", {"success_on": "colour"}, r"success_on must be one of \('position', 'pose'\), got 'colour'"),
        ("cube", "env", {"detail": "fine"}, "detail must be one of"),
        *[("reacher", "expert", {"noise_std": noise}, "noise_std must be finite") for noise in (np.nan, np.inf)],
        *[(name, "expert", {"noise_std": -1.0}, "noise_std must be finite and not negative, got -1") for name in ENVIRONMENTS],
        ("reacher", "expert", {"kind": "sac"}, "kind must be one of .*, got 'sac'"),
        ("cube", "expert", {"noise_smoothing": 0}, "noise_smoothing must be finite and positive, got 0"),
        ("cube", "expert", {"env": gymnasium.make("CartPole-v1")}, "env must be a CubeEnv, got CartPoleEnv"),
        ("push_t", "expert", {"speed": 0.0}, "speed"),
        ("push_t", "expert", {"approach_speed": 60.0}, "approach_speed"),
        *[("push_t", "expert", {name: share}, name) for name, share in (("free_share", 1.5), ("goal_share", -0.1))],
    ],
)
def test_bad_arguments_are_refused(name, part, kwargs, message):
    require_simulator(name, pictures=part == "env")
    entry = ENVIRONMENTS[name]
    with pytest.raises((ValueError, TypeError), match=message):
        (entry.load_env() if part == "env" else entry.load_expert())(**kwargs)


@pytest.mark.parametrize(("name", "kwargs"), EXPERTS)
def test_an_expert_is_fixed_by_its_generator_and_leaves_its_environment_and_arguments_alone(build, name, kwargs):
    env, asked = (build(name, image_size=8, terminate_on_success=False) for _ in range(2))
    assert isinstance(env, PixelGoalEnv)
    asked.reset(seed=4)
    before = asked._get_state()
    runs = []
    for seed in (5, 5, 6):
        expert = ENVIRONMENTS[name].load_expert()(rng=np.random.default_rng(seed), env=asked, **kwargs)
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
