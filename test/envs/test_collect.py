"""Recorded episodes keep the key contract, and their bytes depend on the seed and the episode alone."""

from __future__ import annotations

import multiprocessing
import os

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import check_episode
from torchrl_ficreg.envs import collect_episodes
from torchrl_ficreg.envs.collect import ordered_map
from torchrl_ficreg.envs.two_room import physics, render

SMALL = {"image_size": 16, "max_steps": 12}


def data(episodes):
    return [{key: (value.shape, value.tobytes()) for key, value in episode.items()} for episode in episodes]


def negative_fails(item):
    if item < 0:
        raise ValueError(f"{item} is negative")
    return item * item


def dies_at_two(item):
    if item == 2:
        os._exit(7)
    return item


def worker_threads(item):
    return torch.get_num_threads()


@pytest.fixture(scope="module")
def recorded():
    return list(collect_episodes("two_room", 8, seed=3, num_workers=0))


def test_episodes_keep_the_key_contract_and_stop_at_success_or_after_max_steps(recorded):
    for episode in recorded:
        assert check_episode(episode) == len(episode["action"]) <= 101
    lengths = [len(episode["action"]) for episode in recorded]
    assert min(lengths) < 101 == max(lengths)


def test_each_action_leads_from_its_own_frame_to_the_next(recorded):
    """Replaying the recorded actions gives the recorded states bit for bit, and the states give the pictures."""
    for episode in recorded:
        states, actions = torch.from_numpy(episode["state"]), torch.from_numpy(episode["action"])
        assert torch.equal(physics.step(states[:-1], actions[:-1]), states[1:])
        assert torch.equal(render(states[5], size=64), torch.from_numpy(episode["pixels"][5]))


def test_the_number_of_workers_does_not_change_a_byte():
    """In this process or in two others, 20 episodes come in the same order with the same bytes."""
    alone = data(collect_episodes("two_room", 20, seed=3, num_workers=0, **SMALL))
    assert data(collect_episodes("two_room", 20, seed=3, num_workers=2, **SMALL)) == alone


def test_resuming_gives_the_episodes_that_were_missing():
    whole = data(collect_episodes("two_room", 9, seed=3, num_workers=0, **SMALL))
    rest = data(collect_episodes("two_room", 9, seed=3, start=6, num_workers=0, **SMALL))
    assert rest == whole[6:]
    assert len({episode["state"] for episode in whole}) == 9
    assert data(collect_episodes("two_room", 9, seed=4, num_workers=0, **SMALL)) != whole


def test_expert_and_environment_arguments_arrive():
    """Without noise and with the published wall rule, the expert is at its goal within 70 steps."""
    arguments = {"expert_kwargs": {"noise_std": 0.0}, "env_kwargs": {"collision": "endpoint"}}
    for episode in collect_episodes("two_room", 5, num_workers=0, **arguments):
        assert len(episode["action"]) < 70


def test_stopping_early_leaves_no_process_behind():
    before = set(multiprocessing.active_children())
    episodes = collect_episodes("two_room", 10_000, num_workers=1, **SMALL)
    next(episodes)
    assert set(multiprocessing.active_children()) - before
    episodes.close()
    assert not set(multiprocessing.active_children()) - before


def test_what_a_worker_raises_is_raised_here_after_the_results_before_it():
    results = ordered_map(negative_fails, [1, 2, -3, 4], num_workers=1)
    assert [next(results), next(results)] == [1, 4]
    with pytest.raises(ValueError, match="-3 is negative") as caught:
        next(results)
    assert "negative_fails" in str(caught.value.__cause__)


def test_a_worker_that_dies_is_reported():
    with pytest.raises(RuntimeError, match="died with exit code 7"):
        list(ordered_map(dies_at_two, range(4), num_workers=1))


def test_workers_have_one_torch_thread_and_items_are_drawn_only_as_needed():
    drawn = []

    def items():
        for item in range(50):
            drawn.append(item)
            yield item

    results = ordered_map(worker_threads, items(), num_workers=1)
    assert next(results) == 1
    assert len(drawn) <= 3  # one delivered, two ahead
    assert list(results) == [1] * 49
    assert len(drawn) == 50


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "three_room"}, "unknown environment 'three_room'"),
        ({"start": 5}, r"start must be between 0 and num_episodes \(4\), got 5"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
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
