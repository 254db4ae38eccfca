"""Clips are aligned frames and blocks of one episode, each is visited once an epoch, and a position is one number."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer, TensorStorage

from torchrl_ficreg.data import clip_length, ClipSampler, ClipStorage, EpisodeStore

ALL_KEYS = ("pixels", "action", "state", "episode", "step")
LENGTHS = [31, 16, 15, 2, 20, 40]


@pytest.fixture
def store(make_episode):
    return EpisodeStore.from_episodes([make_episode(number, length) for number, length in enumerate(LENGTHS, 1)])


@pytest.mark.parametrize("num_frames, frame_skip", [(4, 5), (2, 1), (1, 5), (3, 7), (1, 1)])
def test_each_block_holds_the_actions_between_its_frames(store, num_frames, frame_skip):
    clips = ClipStorage(store, range(1, 7), num_frames=num_frames, frame_skip=frame_skip, keys=ALL_KEYS)
    batch = clips[:]
    assert batch.shape == (len(clips), num_frames)
    assert batch["action"].dtype == torch.float32 and batch["pixels"].dtype == torch.uint8
    masked = 0
    for clip in batch:
        episode = clip["episode"][0].item()
        start = clip["step"][0].item()
        for k, frame in enumerate(clip):
            step = start + k * frame_skip
            assert frame["step"] == step and frame["episode"] == episode
            assert (frame["pixels"][0] == episode).all() and (frame["pixels"][1] == step).all()
            assert frame["state"].tolist() == [episode, step]
            inside = step + frame_skip <= LENGTHS[episode - 1] - 1
            assert frame["mask"].item() == inside
            assert inside or k == num_frames - 1
            raw = frame["action"].view(frame_skip, 3)  # [F, A], time-major
            expected = [[episode, t, -np.float32(t**2 / 7)] for t in range(step, step + frame_skip)]
            assert raw.tolist() == (expected if inside else [[0.0] * 3] * frame_skip)
            masked += not inside
    starts = [max(0, length - clip_length(num_frames, frame_skip) + 1) for length in LENGTHS]
    assert masked == sum(min(frame_skip, count) for count in starts)  # the last F starts of each episode


def test_every_legal_start_is_a_clip(store):
    clips = ClipStorage(store, range(1, 7), num_frames=4, frame_skip=5, keys=("episode", "step"))
    got = {(clip["episode"][0].item(), clip["step"][0].item()) for clip in clips[:]}
    legal = {(e, s) for e, length in enumerate(LENGTHS, 1) for s in range(length - 3 * 5)}
    assert got == legal and len(clips) == len(legal)
    assert clips.num_short_episodes == 2  # 15 and 2 rows
    some = ClipStorage(store, [2, 6], num_frames=4, frame_skip=5, keys=("episode",))
    assert set(some[:]["episode"].flatten().tolist()) == {2, 6} and len(some) == 1 + 25


def test_indices_of_every_kind(store):
    clips = ClipStorage(store, range(1, 7), num_frames=4, frame_skip=5, keys=ALL_KEYS)
    everything = clips[:]
    last = len(clips) - 1
    for index in (3, -1, [2, 0], np.array([5, 5]), torch.tensor([[1, 2], [3, last]]), slice(2, 9, 3)):
        assert (clips[index] == everything[index]).all()
    chosen = torch.arange(len(clips)) % 2 == 0
    assert (clips[chosen] == everything[chosen]).all()
    for index in (last + 1, -last - 2, [0, last + 1]):
        with pytest.raises(IndexError, match=f"0 to {last}"):
            clips[index]
    with pytest.raises(TypeError, match="integers"):
        clips[[0.5]]


def test_mistakes_are_refused(store):
    with pytest.raises(ValueError, match=r"needs 46 rows \(4 frames, 15 steps apart\), but the 6 .* 2 to 40 rows"):
        ClipStorage(store, range(1, 7), num_frames=4, frame_skip=15)
    with pytest.raises(ValueError, match="0 episodes have no rows"):
        ClipStorage(store, [], num_frames=4, frame_skip=5)
    with pytest.raises(ValueError, match="must be positive, got 0 and 5"):
        ClipStorage(store, [1], num_frames=0, frame_skip=5)
    for keys in ((), ("pixels", "reward")):
        with pytest.raises(KeyError, match="a clip holds some of"):
            ClipStorage(store, [1], num_frames=4, frame_skip=5, keys=keys)


def numbers(count, batch_size, **kwargs):
    """A buffer of the numbers 0 .. count - 1 in the order of a ClipSampler."""
    return ReplayBuffer(storage=TensorStorage(torch.arange(count)), sampler=ClipSampler(**kwargs), batch_size=batch_size)


@pytest.mark.parametrize("count, batch_size, drop_last", [(20, 5, True), (23, 5, False), (23, 5, True), (5, 5, True)])
def test_an_epoch_visits_each_clip_once(count, batch_size, drop_last):
    buffer = numbers(count, batch_size, drop_last=drop_last)
    orders = []
    for _ in range(3):
        batches = [batch.tolist() for batch in buffer]
        order = sum(batches, [])
        assert len(set(order)) == len(order) == (count // batch_size * batch_size if drop_last else count)
        assert all(len(batch) == batch_size for batch in batches[:-1])
        orders.append(order)
    assert orders[0] != orders[1] != orders[2]
    assert len(set(sum(orders, []))) == count  # what one epoch leaves out, another one serves


def test_first_batches_are_uniform_over_clips():
    counts = torch.zeros(10)
    for seed in range(4000):
        counts[ClipSampler(seed=seed).sample(range(10), 2)[0]] += 1
    expected = 4000 * 2 / 10
    chi_square = ((counts - expected) ** 2 / expected).sum()
    assert chi_square < 27.9  # 99.9 % quantile at 9 degrees of freedom (draws without replacement only lower it)


def test_the_order_depends_on_the_seed_alone():
    torch.manual_seed(0), np.random.seed(0)
    first = numbers(50, 5, seed=1).sample().tolist()
    state = torch.get_rng_state()
    torch.manual_seed(1), np.random.seed(1)
    buffer = numbers(50, 5, seed=1)
    buffer.set_rng(torch.Generator().manual_seed(9))
    assert buffer.sample().tolist() == first != numbers(50, 5, seed=2).sample().tolist()
    torch.manual_seed(0)
    assert torch.get_rng_state().equal(state)
    assert numbers(6, 3, shuffle=False).sample().tolist() == [0, 1, 2]


def test_any_position_can_be_sought_and_saved():
    sequence = [batch.tolist() for buffer in [numbers(23, 5, seed=4)] for _ in range(3) for batch in buffer]
    buffer, other = numbers(23, 5, seed=4), numbers(23, 5, seed=99)
    for position in (7, 0, 11, 3, 4):
        buffer.sampler.seek(position)
        state = buffer.sampler.state_dict()
        assert all(isinstance(value, int) for value in state.values())
        other.sampler.load_state_dict(state)
        assert buffer.sample().tolist() == other.sample().tolist() == sequence[position]
    buffer.sampler.seek(2)
    assert [batch.tolist() for batch in buffer] == sequence[2:4]  # what is left of the epoch
    with pytest.raises(ValueError, match="not be negative"):
        buffer.sampler.seek(-1)


def test_a_position_is_not_reinterpreted():
    buffer = numbers(23, 5)
    buffer.sample()
    other = numbers(24, 5)
    other.sampler.load_state_dict(buffer.sampler.state_dict())
    with pytest.raises(ValueError, match="batches of 5 out of 23 clips, got batches of 5 out of 24"):
        other.sample()
    with pytest.raises(ValueError, match="got batches of 4"), pytest.warns(UserWarning, match="conflicting"):
        buffer.sample(4)
    with pytest.raises(ValueError, match="3 clips do not fill a batch of 5"):
        numbers(3, 5).sample()
    with pytest.raises(ValueError, match="seed"):
        ClipSampler(seed=-1)


def test_sampler_and_storage_serve_a_plain_torchrl_buffer(store):
    clips = ClipStorage(store, range(1, 7), num_frames=4, frame_skip=5, keys=ALL_KEYS)
    buffer = TensorDictReplayBuffer(storage=clips, sampler=ClipSampler(), batch_size=6)
    batch = buffer.sample()
    assert batch.shape == (6, 4) and (clips[batch["index"][:, 0]] == batch.exclude("index")).all()
