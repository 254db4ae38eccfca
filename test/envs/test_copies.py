"""A copy of a running environment steps like the original, to the last bit, or there is none."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch

from torchrl_ficreg.envs import ENVIRONMENTS, make_env
from torchrl_ficreg.envs._gl import gl_works

COPIERS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}
SETTINGS = {"push_t": [{}, {"legacy_restore": True}]}
# The disc beside the bar of the T and driven into it: the solver remembers contacts between two steps.
CONTACT = {"push_t": [190.0, 300.0, 256.0, 300.0, 0.5, 0.0, 0.0]}


def build(name, **kwargs):
    if name in ("reacher", "cube"):
        pytest.importorskip("mujoco")
        if not gl_works():
            pytest.skip("no GL")
    return ENVIRONMENTS[name].load_env()(image_size=16, **kwargs)


def assert_same(first, second):
    assert first.keys() == second.keys()
    for key in first:
        assert np.array_equal(first[key], second[key]), key


@pytest.mark.parametrize("copier", COPIERS)
@pytest.mark.parametrize("steps", [None, 0, 1, 7])
@pytest.mark.parametrize(
    ("name", "kwargs"), [(name, kwargs) for name in ENVIRONMENTS for kwargs in SETTINGS.get(name, [{}])]
)
def test_a_copy_steps_and_draws_like_the_original(name, kwargs, steps, copier):
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
    ours = [env.step(action)[0] for action in actions]
    theirs = [twin.step(action)[0] for action in actions]
    for first, second in zip(ours, theirs):
        assert_same(first, second)
    assert_same(env.reset()[0], twin.reset()[0])  # the generators are copied too
    env.close()
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


@pytest.mark.parametrize("copier", [*COPIERS.values(), copy.copy])
def test_a_batch_in_worker_processes_refuses(copier):
    env = make_env("two_room", 2, image_size=8, num_workers=1)
    try:
        with pytest.raises(TypeError, match="neither copied nor pickled: build another one by make_env"):
            copier(env)
        assert env.reset()["state"].shape == (2, 2)
    finally:
        env.close()


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
@pytest.mark.parametrize("value", [1e300, -1e3])
def test_an_action_far_beyond_its_bounds_is_refused_by_every_environment(name, value):
    env = build(name)
    env.reset(seed=0)
    before = env._get_state()
    with pytest.raises(ValueError, match="action must be within"):
        env.step(np.full(env.action_space.shape, value))
    assert np.array_equal(env._get_state(), before)
    env.close()


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
@pytest.mark.parametrize("size", [True, 8.0, "8"])
def test_a_picture_size_that_is_no_integer_is_refused(name, size):
    with pytest.raises(ValueError, match="image_size must be a positive integer"):
        ENVIRONMENTS[name].load_env()(image_size=size)


@pytest.mark.parametrize("name", ["two_room", "push_t"])
def test_sizes_and_seeds_may_be_integers_of_numpy(name):
    env = ENVIRONMENTS[name].load_env()(image_size=np.int64(16))
    assert type(env.image_size) is int and env.reset(seed=0)[0]["pixels"].shape == (3, 16, 16)
    assert_same(env.reset(seed=np.int64(3))[0], env.reset(seed=3)[0])
    env.close()


def test_a_scene_that_is_never_restored_keeps_no_endless_memory(monkeypatch):
    monkeypatch.setattr("torchrl_ficreg.envs.push_t.physics.MOST_CALLS", 20)
    env = ENVIRONMENTS["push_t"].load_env()(image_size=8)
    env.reset(seed=0)
    for _ in range(50):
        env.step(np.zeros(2))
    assert len(env._world._journal) <= 21
    for copier in COPIERS.values():
        with pytest.raises(RuntimeError, match="more than 20 times since its last set_state.* reset it first"):
            copier(env)
    env.reset()
    twin = copy.deepcopy(env)
    assert_same(env.step(np.ones(2))[0], twin.step(np.ones(2))[0])


@pytest.mark.parametrize("name", ["num_envs", "num_workers", "seed", "max_episode_steps"])
@pytest.mark.parametrize("value", [True, 2.0, "2"])
def test_numbers_of_another_type_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be an integer, got"):
        make_env("two_room", **{name: value})
