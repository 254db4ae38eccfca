"""Claims about splits: disjoint, complete, stable while a dataset grows, and exact at every size."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_ficreg.data import split_episodes

SPLITS = ("train", "validation", "evaluation")


@pytest.mark.parametrize("seed", [0, 1, 42])
@pytest.mark.parametrize("fractions", [(0.8, 0.1, 0.1), (0.5, 0.0, 0.5), (0.9, 0.1, 0.0), (1.0, 0.0, 0.0)])
def test_every_episode_is_in_exactly_one_split(seed, fractions):
    parts = [split_episodes(1000, split, fractions=fractions, seed=seed) for split in SPLITS]
    assert sorted(np.concatenate(parts)) == list(range(1, 1001))
    assert [len(part) > 0 for part in parts] == [fraction > 0 for fraction in fractions]


def test_growth_moves_no_episode_and_every_prefix_has_nearly_the_exact_fractions():
    for split in SPLITS:
        large = split_episodes(1000, split)
        for size in (1, 7, 100, 999):
            assert split_episodes(size, split).tolist() == large[large <= size].tolist()
    for seed in range(5):
        large = split_episodes(500, "train", seed=seed)
        for size in range(1, 500):  # independent draws would stray by 18 (2 sigma) at 500
            assert abs((large <= size).sum() - 0.8 * size) < 3


def test_the_seed_changes_the_split_and_all_is_everything():
    assert split_episodes(100, "evaluation", seed=0).tolist() != split_episodes(100, "evaluation", seed=1).tolist()
    assert split_episodes(3, "all").tolist() == [1, 2, 3]


@pytest.mark.parametrize("fractions", [(0.8, 0.1), (0.8, 0.1, 0.2), (0.0, 0.5, 0.5), (1.1, -0.1, 0.0)])
def test_bad_fractions_and_unknown_splits_are_refused(fractions):
    with pytest.raises(ValueError, match="summing to 1"):
        split_episodes(10, "train", fractions=fractions)
    with pytest.raises(ValueError, match="split must be one of .* got 'test'"):
        split_episodes(10, "test")
