"""Recorded episodes keep the key contract, and their bytes depend on the seed and the episode alone."""

from __future__ import annotations

import itertools
import multiprocessing

import numpy as np
import pytest

from torchrl_ficreg.data import check_episode
from torchrl_ficreg.envs import collect_episodes, ENVIRONMENTS

SMALL = {"image_size": 16, "max_steps": 12}


def data(episodes):
    return [{key: (value.shape, value.tobytes()) for key, value in episode.items()} for episode in episodes]


@pytest.fixture(scope="module")
def recorded():
    return list(collect_episodes("two_room", 8, seed=3, num_workers=0))


def test_episodes_keep_the_key_contract_and_stop_at_success_or_after_max_steps(recorded):
    for episode in recorded:
        assert check_episode(episode) == len(episode["action"]) <= 101
    lengths = [len(episode["action"]) for episode in recorded]
    assert min(lengths) < 101 == max(lengths)


@pytest.mark.parametrize("name", sorted(ENVIRONMENTS))
def test_each_action_leads_from_its_own_frame_to_the_next(build, name):
    """Replaying the recorded actions gives the recorded states bit for bit, and the states give the pictures."""
    env_kwargs = {"stop_within_action": False} if name == "reacher" else {}
    env = build(name, **env_kwargs)
    settings = {"image_size": 16, "max_steps": 12, "stop_at_success": False, "env_kwargs": env_kwargs}
    (episode,) = collect_episodes(name, 1, seed=3, num_workers=0, **settings)
    assert check_episode(episode) == 13 and not episode["action"][-1].any()
    observation, _ = env.reset(options={"state": episode["state"][0]})
    for t, action in enumerate(episode["action"]):
        for key in ("pixels", "state"):
            assert observation[key].tobytes() == episode[key][t].tobytes(), (t, key)
        observation = env.step(action)[0]


def test_the_number_of_workers_does_not_change_a_byte_and_stopping_early_leaves_no_process():
    """In this process or in two others, episodes have the same order and bytes."""
    alone = data(collect_episodes("two_room", 20, seed=3, num_workers=0, **SMALL))
    before = set(multiprocessing.active_children())
    episodes = collect_episodes("two_room", 10_000, seed=3, num_workers=2, **SMALL)
    assert data(itertools.islice(episodes, 20)) == alone
    assert len(set(multiprocessing.active_children()) - before) == 2
    episodes.close()
    assert not set(multiprocessing.active_children()) - before


def test_resuming_gives_the_episodes_that_were_missing():
    whole = data(collect_episodes("two_room", 9, seed=3, num_workers=0, **SMALL))
    for start, step in [(6, 1), (2, 3)]:
        rest = data(collect_episodes("two_room", 9, seed=3, start=start, step=step, num_workers=0, **SMALL))
        assert rest == whole[start::step]
    assert len({episode["state"] for episode in whole}) == 9
    assert data(collect_episodes("two_room", 9, seed=4, num_workers=0, **SMALL)) != whole


def test_expert_and_environment_arguments_arrive():
    """Without noise and with the published wall rule, the expert is at its goal within 70 steps."""
    arguments = {"expert_kwargs": {"noise_std": 0.0}, "env_kwargs": {"collision": "endpoint"}}
    for episode in collect_episodes("two_room", 5, num_workers=0, **arguments):
        assert len(episode["action"]) < 70


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "three_room"}, "unknown environment 'three_room'"),
        ({"start": 5}, r"start must be between 0 and num_episodes \(4\), got 5"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
        ({"step": 0}, "step must be at least 1"),
        ({"num_workers": -1}, "num_workers must be at least 0"),
        ({"seed": -1}, "seed must not be negative"),
    ],
)
def test_bad_arguments_are_refused_at_the_call_not_at_the_first_episode(arguments, message):
    with pytest.raises(ValueError, match=message):
        collect_episodes(**{"name": "two_room", "num_episodes": 4, **arguments})


def test_an_unknown_expert_argument_is_raised_by_the_iterator():
    with pytest.raises(TypeError, match="noise"):
        next(collect_episodes("two_room", 1, num_workers=0, expert_kwargs={"noise": np.pi}))
