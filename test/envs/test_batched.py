"""N environments in W processes are the N environments of one process, bit for bit, with the same errors."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import threading
import time

import gymnasium
import numpy as np
import pytest
import torch
from simulators import assert_same
from torchrl.envs.utils import check_env_specs

from torchrl_ficreg.envs import make_env
from torchrl_ficreg.envs.batched import WorkerGroupsEnv
from torchrl_ficreg.envs.two_room.env import TwoRoomEnv

NAME = "test/FragileRoom-v0"
BREAKING, ENDLESS = 0.125, 0.25  # actions
SETTINGS = {"image_size": 16, "max_episode_steps": 6, "seed": 3}


class FragileRoom(TwoRoomEnv):
    """A TwoRoom that one action breaks and one keeps busy; registered by this process alone."""

    def _step_physics(self, action):
        if action[0] == BREAKING:
            raise ArithmeticError("the arm is broken")
        if action[0] == ENDLESS:
            time.sleep(60)
        super()._step_physics(action)


class NoRoom(TwoRoomEnv):
    """A TwoRoom that cannot be built."""

    def __init__(self, **kwargs):
        raise ImportError("pip install a-room")


gymnasium.register(NAME, FragileRoom)
gymnasium.register("test/NoRoom-v0", NoRoom)


def scenes(count):
    return [{"options": {"state": np.array([30.1 + i, 40.2]), "goal_state": np.array([150.3 + i, 60.4])}} for i in range(count)]


@pytest.fixture(scope="module")
def groups():
    """Five environments in groups of two and three."""
    env = make_env(NAME, 5, num_workers=2, **SETTINGS)
    yield env
    env.close()


@pytest.fixture
def both(groups):
    """The five in worker processes and five in this one, equally seeded."""
    serial = make_env(NAME, 5, **SETTINGS)
    assert groups.set_seed(7) == serial.set_seed(7)
    return groups, serial


def test_its_specs_hold_and_are_those_of_a_serial_batch(both):
    groups, serial = both
    assert isinstance(groups, WorkerGroupsEnv) and len(multiprocessing.active_children()) == 2
    assert groups.batch_size == (5,)
    check_env_specs(groups)
    for part in ("observation_spec", "full_action_spec", "full_reward_spec", "full_done_spec", "state_spec"):
        ours, theirs = getattr(groups, part), getattr(serial, part)
        assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
        assert all(ours[key] == theirs[key] for key in ours.keys(True, True)), part


@pytest.mark.parametrize(
    "breaking",
    [
        {"break_when_any_done": False},  # partial resets
        {"break_when_any_done": True},
        {"break_when_any_done": False, "break_when_all_done": True},  # partial steps
    ],
)
def test_rollouts_equal_those_of_a_serial_batch(both, breaking):
    """Same seed, same scenes, same actions, same episodes of different lengths: seeds belong to the environment."""
    runs = []
    for env in both:
        torch.manual_seed(0)
        runs.append(env.rollout(15, **breaking))
    assert_same(*(run.flatten_keys() for run in runs))
    assert len(runs[0]["state"][:, 0].unique(dim=0)) == 5


def test_a_seed_of_five_continues_where_that_of_two_and_three_ends(both):
    """Environment 2 is the first of the second group; static seeds are equal for all."""
    groups, _ = both
    states = groups.reset()["state"]
    single = make_env(NAME, **{**SETTINGS, "seed": None})
    seed = 7
    for state in states:
        seed = single.set_seed(seed)
        assert torch.equal(single.reset()["state"], state)
    assert groups.set_seed(7, static_seed=True) == 7 and len(groups.reset()["state"].unique(dim=0)) == 1


@pytest.mark.parametrize("columns", [(), (1,)])
def test_partial_resets_leave_the_others_alone(both, columns):
    mask = torch.tensor([False, True, False, False, True]).reshape(5, *columns)
    action = torch.linspace(-1, 1, 10).reshape(5, 2)
    outcomes = []
    for env in both:
        td = env.reset(list_of_kwargs=scenes(5))
        td = env.step_mdp(env.step(td.set("action", action)))
        outcomes.append(env.reset(td.clone().set("_reset", mask), list_of_kwargs=scenes(5)))
        assert torch.equal(outcomes[-1]["pixels"][0], td["pixels"][0])
        outcomes.append(env.step(outcomes[-1].clone().set("action", action)))
    assert outcomes[0]["state"][[1, 4]].tolist() == [[31.1, 40.2], [34.1, 40.2]]
    assert outcomes[0]["state"][0].tolist() == [25.1, pytest.approx(40.2 - 35 / 9)]
    for ours, serial in zip(outcomes[:2], outcomes[2:]):
        assert_same(ours.flatten_keys(), serial.flatten_keys())


def test_a_collector_runs_on_it(both):
    from torchrl.collectors import Collector  # here, because the workers import this module, and it is slow

    batches = []
    for env in both:
        torch.manual_seed(0)
        collector = Collector(env, None, frames_per_batch=40, total_frames=-1)  # 8 steps: past the limit of 6
        batches.append(next(iter(collector)).exclude("collector"))
        collector.shutdown(close_env=False)
    assert_same(*(batch.flatten_keys() for batch in batches))
    assert batches[0]["next", "truncated"].any()


def test_errors_are_those_of_a_serial_batch_and_the_batch_stays_usable(groups):
    bad = scenes(5)
    bad[3]["options"]["state"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"option 'state' \[0.0, 0.0\] is not legal"):
        groups.reset(list_of_kwargs=bad)
    with pytest.raises(ValueError, match="one entry per environment, 5, got 4"):
        groups.reset(list_of_kwargs=scenes(4))
    td = groups.reset(list_of_kwargs=scenes(5))
    with pytest.raises(ArithmeticError, match="the arm is broken"):
        groups.step(td.clone().set("action", torch.full((5, 2), BREAKING)))
    assert groups.reset(list_of_kwargs=scenes(5))["state"][4].tolist() == [34.1, 40.2]


def test_it_refuses_to_be_copied_and_does_not_overwrite_what_it_returned(groups):
    reset = groups.reset(list_of_kwargs=scenes(5))
    kept = reset.clone()
    groups.step(groups.rand_action(reset.clone()))
    for copier in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="neither copied nor pickled: build another one by make_env"):
            copier(groups)
    assert groups.reset()["state"].shape == (5, 2)
    assert_same(reset, kept)


def test_an_environment_that_cannot_be_built_raises_its_error_and_leaves_no_process(groups):
    before = set(multiprocessing.active_children())
    with pytest.raises(ImportError, match="pip install a-room"):
        make_env("test/NoRoom-v0", 2, num_workers=1)
    assert set(multiprocessing.active_children()) == before


def test_a_killed_worker_raises_at_once_and_leaves_no_process(groups):
    """No waiting for the other worker, which is busy for a minute."""
    before = set(multiprocessing.active_children())
    env = make_env(NAME, 2, num_workers=2, image_size=8)
    td = env.reset().set("action", torch.full((2, 2), ENDLESS))
    children = [child for child in multiprocessing.active_children() if child not in before]
    threading.Timer(0.2, max(children, key=lambda child: child.pid).kill).start()
    began = time.monotonic()
    with pytest.raises(RuntimeError, match=r"worker process [12] of 2 died with exit code -9"):
        env.step(td)
    assert time.monotonic() - began < 30 and set(multiprocessing.active_children()) == before
    with pytest.raises(RuntimeError, match="have ended"):
        env.reset()
    env.close()
    with pytest.raises(RuntimeError, match="closed already"):
        env.close(raise_if_closed=True)
