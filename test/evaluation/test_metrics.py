"""Intervals and correlations against published or hand-computed values, distance profiles of known encoders."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.evaluation import latent_distance, rank_correlation, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),  # Newcombe (1998), Statistics in Medicine 17, table I, method 3
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0000),  # by symmetry from 0 of 29: 0 to 0.1170
        (0, 0, 0.0, 1.0),  # no trial tells nothing
    ],
)
def test_the_interval_is_the_published_one(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-4)


def test_the_interval_is_symmetric_stays_in_bounds_and_shrinks_with_more_trials():
    for trials in (1, 7, 100):
        for successes in range(trials + 1):
            low, high = wilson_interval(successes, trials)
            assert 0 <= low <= successes / trials <= high <= 1 and low < high
            assert wilson_interval(trials - successes, trials) == pytest.approx((1 - high, 1 - low))
            wide, narrow = wilson_interval(successes, trials), wilson_interval(successes * 10, trials * 10)
            assert narrow[1] - narrow[0] < wide[1] - wide[0]


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 5)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match=f"got {successes} of {trials}"):
        wilson_interval(successes, trials)


VALUES = np.random.default_rng(0).normal(size=50)
IQ = np.array([106, 100, 86, 101, 99, 103, 97, 113, 112, 110])
HOURS = np.array([7, 27, 2, 50, 28, 29, 20, 12, 6, 17])


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (IQ, HOURS, -29 / 165),  # ten pupils, ranked by IQ and by hours of television: a standard textbook example
        (VALUES, np.exp(VALUES), 1),  # the order alone counts
        (VALUES, -(VALUES**3), -1),
        (np.array([0, 1, 1, 2]), np.arange(4), 4.5 / (4.5 * 5) ** 0.5),  # equal values share a rank: 1, 2.5, 2.5, 4
        (np.arange(10), np.zeros(10), 0),  # of a collapsed latent space: no order
    ],
    ids=["textbook", "increasing", "decreasing", "ties", "collapsed"],
)
def test_rank_correlation_is_spearmans(first, second, expected):
    assert rank_correlation(first, second) == pytest.approx(expected)


def positions(scale: float = 1.0) -> SimpleNamespace:
    """A world model whose latent is the state itself, which the first two pixels spell out."""
    return SimpleNamespace(action_mean=torch.zeros(2), encode=lambda pixels: scale * pixels[:, 0, 0, :2].float())


@pytest.fixture(scope="module")
def walks() -> OfflineTrajectories:
    """Ten episodes of whole-number states, written into the pixels."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(10):
        state = rng.integers(0, 256, (30, 2))
        pixels = np.zeros((30, 3, 4, 4), np.uint8)
        pixels[:, 0, 0, :2] = state
        action = np.pad(rng.normal(size=(29, 2)), ((0, 1), (0, 0))).astype(np.float32)
        episodes.append({"pixels": pixels, "action": action, "state": state.astype(float)})
    return OfflineTrajectories.from_episodes(episodes, split="all", num_frames=2, frame_skip=1)


@pytest.mark.parametrize(("scale", "expected"), [(0.1, 1), (0.0, 0)], ids=["the state", "collapsed"])
def test_a_latent_that_is_the_state_follows_it_perfectly_and_a_collapsed_one_not_at_all(walks, scale, expected):
    profile = latent_distance(positions(scale), walks, num_frames=100)
    assert profile.rank_correlation == pytest.approx(expected, abs=1e-6)
    assert len(profile.true) == 100 * 99 / 2
    assert profile.latent == pytest.approx(scale * profile.true, rel=1e-5)


def test_the_same_frames_are_compared_every_time_and_never_more_than_there_are(walks):
    first, again = (latent_distance(positions(), walks, num_frames=50, seed=1) for _ in range(2))
    assert np.array_equal(first.true, again.true)
    assert not np.array_equal(first.true, latent_distance(positions(), walks, num_frames=50, seed=2).true)
    assert len(latent_distance(positions(), walks, num_frames=10_000).true) == 300 * 299 / 2


def test_bins_hold_equally_many_pairs_and_ordered_quantiles(walks):
    center, quantiles = latent_distance(positions(), walks).bins(count=10)
    assert center.shape == (10,) and quantiles.shape == (10, 3)
    assert (np.diff(center) > 0).all() and (np.diff(quantiles, axis=1) >= 0).all()
