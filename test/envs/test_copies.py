"""A copy of a running environment steps like the original, bit for bit, or copying raises an error."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from simulators import assert_same

from torchrl_ficreg.envs import ENVIRONMENTS, make_env

COPIERS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}
SETTINGS = {"push_t": [{}, {"legacy_restore": True}]}
# The disc beside the bar of the T and driven into it: the solver caches contacts between two steps.
CONTACT = {"push_t": [190.0, 300.0, 256.0, 300.0, 0.5, 0.0, 0.0]}


@pytest.mark.parametrize("copier", COPIERS)
@pytest.mark.parametrize("steps", [None, 0, 7])
@pytest.mark.parametrize(("name", "kwargs"), [(name, kwargs) for name in ENVIRONMENTS for kwargs in SETTINGS.get(name, [{}])])
def test_a_copy_steps_and_draws_like_the_original(build, name, kwargs, steps, copier):
    """Before the first reset, after it, and in the middle of an episode; neither moves the other."""
    env = build(name, **kwargs)
    env.action_space.seed(0)
    if steps is not None:
        env.reset(seed=3, options={"state": CONTACT[name]} if name in CONTACT else None)
        for _ in range(steps):
            env.step(np.array([1.0, 0.1]) if name in CONTACT else env.action_space.sample())
    twin = COPIERS[copier](env)
    if steps is None:
        assert_same(env.reset(seed=5)[0], twin.reset(seed=5)[0])
    actions = [env.action_space.sample() for _ in range(4)]
    ours, theirs = ([one.step(action)[0] for action in actions] for one in (env, twin))
    for first, second in zip(ours, theirs):
        assert_same(first, second)
    assert_same(env.reset()[0], twin.reset()[0])  # the generators are copied too
    twin.close()


@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_torchrl_environment_is_copied_with_its_wrappers(num_envs):
    env = make_env("push_t", num_envs, image_size=16, seed=0, max_episode_steps=5)
    td = env.reset()
    td = env.step_mdp(env.step(env.rand_action(td)))
    twin = copy.deepcopy(env)
    action = td.clone().set("action", torch.ones_like(td["action"]))
    ours, theirs = env.step(action.clone())["next"], twin.step(action.clone())["next"]
    assert all(torch.equal(ours[key], theirs[key]) for key in ("state", "pixels", "success"))


def test_the_journal_of_a_scene_that_is_never_restored_is_bounded(build, monkeypatch):
    env = build("push_t")
    monkeypatch.setattr("torchrl_ficreg.envs.push_t.physics.MOST_CALLS", 20)
    env.reset(seed=0)
    for _ in range(50):
        env.step(np.zeros(2))
    assert len(env._world._journal) <= 21
    for copier in COPIERS.values():
        with pytest.raises(RuntimeError, match="more than 20 times since its last set_state.* reset it first"):
            copier(env)
    env.reset()
    assert_same(copy.deepcopy(env).step(np.ones(2))[0], env.step(np.ones(2))[0])
