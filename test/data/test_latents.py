"""Claims about encoded episodes: every frame once and in order, and rows that pair frames and actions rightly."""

from __future__ import annotations

import pytest
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.latents import encode_episodes, GoalRows

LENGTHS = [20, 3, 7, 11, 20, 6, 30, 4]


@pytest.fixture
def dataset(make_episode):
    """Frame and latent of step t of episode e: (e, t). Frame skip 3."""
    episodes = [make_episode(number, length) for number, length in enumerate(LENGTHS, start=1)]
    return OfflineTrajectories.from_episodes(episodes, split="all", num_frames=2, frame_skip=3)


def corner(pixels):
    return pixels[:, :2, 0, 0].float()


@pytest.fixture
def rows(dataset):
    return GoalRows(dataset, encode_episodes(dataset, corner), max_blocks=4)


@pytest.mark.parametrize("batch_size", [1, 7, 20, 1000])
def test_every_frame_is_encoded_once_in_order_and_in_full_batches(dataset, batch_size):
    """A batch belongs to the encoder: writing into it leaves the recorded frames alone."""
    sizes = []

    def encode(pixels):
        sizes.append(len(pixels))
        latent = corner(pixels).clone()
        pixels.zero_()
        return latent

    latent = encode_episodes(dataset, encode, batch_size=batch_size)
    expected = [[float(number), float(step)] for number, length in enumerate(LENGTHS, start=1) for step in range(length)]
    assert latent.tolist() == encode_episodes(dataset, corner).tolist() == expected
    assert all(size == batch_size for size in sizes[:-1]) and sum(sizes) == sum(LENGTHS)


def test_a_split_is_encoded_for_itself(make_episode):
    episodes = [make_episode(number) for number in range(1, 21)]
    held_out = OfflineTrajectories.from_episodes(episodes, split="validation", num_frames=2, frame_skip=3)
    latent = encode_episodes(held_out, corner)
    assert latent[:, 0].unique().tolist() == held_out.episodes["episode"].tolist()


def test_a_row_is_a_frame_a_later_one_and_the_block_between(dataset, rows):
    batch = rows.sample(2000, generator=torch.Generator().manual_seed(0))
    (episode, step), (same, later) = batch["latent"].T, batch["goal_latent"].T
    assert torch.equal(episode, same) and torch.equal(later - step, 3.0 * batch["blocks"])
    steps = step.unsqueeze(1) + torch.arange(3)
    raw = torch.stack([episode.unsqueeze(1).expand_as(steps), steps, -steps.square() / 7], -1)  # as make_episode has it
    torch.testing.assert_close(batch["action"], dataset.statistics.normalize(raw.flatten(1)))


def test_every_legal_start_and_every_distance_is_drawn_equally_often(rows):
    """A start needs one whole block; of its whole blocks, at most four, each is as likely."""
    batch = rows.sample(200_000, generator=torch.Generator().manual_seed(0))
    place = batch["latent"].long()
    places = [(number, step, length) for number, length in enumerate(LENGTHS, 1) for step in range(length)]
    reach = {(number, step): min(4, (length - 1 - step) // 3) for number, step, length in places}
    starts = {start: blocks for start, blocks in reach.items() if blocks}
    drawn, counts = place.unique(dim=0, return_counts=True)
    assert {tuple(start) for start in drawn.tolist()} == set(starts) and len(rows) == len(starts)
    share = counts / len(place) * len(starts)
    assert (share - 1).abs().max() < 0.15
    long = batch["blocks"][(place[:, 0] == 7) & (place[:, 1] <= 17)]  # four blocks fit there
    frequency = torch.bincount(long, minlength=5)[1:] / len(long)
    torch.testing.assert_close(frequency, torch.full((4,), 0.25), atol=0.01, rtol=0)
    assert all(starts[tuple(at)] >= k for at, k in zip(place[:5000].tolist(), batch["blocks"][:5000].tolist()))


def test_the_draw_belongs_to_the_generator(rows):
    first, again, other = (rows.sample(50, generator=torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
    assert (first == again).all() and not (first == other).all()


def test_mistakes_are_refused(dataset):
    latent = encode_episodes(dataset, corner)
    with pytest.raises(ValueError, match="max_blocks must be positive, got 0"):
        GoalRows(dataset, latent, max_blocks=0)
    with pytest.raises(ValueError, match="the 'all' split has 101 frames, got latents"):
        GoalRows(dataset, latent[:-1], max_blocks=1)
    with pytest.raises(ValueError, match="batch_size must be positive"):
        encode_episodes(dataset, corner, batch_size=0)
    with pytest.raises(ValueError, match="must map 101 frames to latents"):
        encode_episodes(dataset, lambda pixels: corner(pixels)[:1])
    with pytest.raises(ValueError, match="NaN or an infinity"):
        encode_episodes(dataset, lambda pixels: corner(pixels) / 0)
