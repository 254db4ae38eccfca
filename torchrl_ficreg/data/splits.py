"""Which episodes belong to training, validation and evaluation."""

from __future__ import annotations

from typing import Literal

import numpy as np

Split = Literal["train", "validation", "evaluation", "all"]

SPLITS = ("train", "validation", "evaluation")

_GOLDEN = (5**0.5 - 1) / 2


def split_episodes(
    num_episodes: int, split: Split, *, fractions: tuple[float, float, float] = (0.8, 0.1, 0.1), seed: int = 0
) -> np.ndarray:
    """Ids of the episodes of a split.

    Episode e falls where ``frac(offset(seed) + e * 0.618...)`` lies among the cumulative fractions. It depends
    on nothing but e and the seed, so an episode never changes its split when the dataset grows; and because
    multiples of the golden ratio are evenly spread, every prefix of a dataset has nearly the exact fractions.

    Args:
        num_episodes: episodes in the dataset, with ids 1 to ``num_episodes``.
        split: ``"train"``, ``"validation"``, ``"evaluation"`` or ``"all"``.
        fractions: parts of train, validation and evaluation; not negative, train positive, summing to 1.
        seed: picks the offset.

    Returns:
        int64 [E], ascending.

    Raises:
        ValueError: unknown split, or bad fractions.

    Examples:
        >>> split_episodes(10, "validation").tolist(), split_episodes(30, "validation").tolist()
        ([2, 10], [2, 10, 23])
    """
    if split != "all" and split not in SPLITS:
        raise ValueError(f"split must be one of {(*SPLITS, 'all')}, got {split!r}.")
    wrong_sum = len(fractions) != len(SPLITS) or abs(sum(fractions) - 1) > 1e-6
    if wrong_sum or min(fractions) < 0 or fractions[0] <= 0:
        raise ValueError(f"split fractions are three numbers >= 0, the first > 0, summing to 1, got {fractions}.")
    episodes = np.arange(1, num_episodes + 1)
    if split == "all":
        return episodes
    position = (np.random.default_rng(seed).random() + episodes * _GOLDEN) % 1.0  # [E] in [0, 1)
    upper = np.cumsum(fractions)
    upper[np.flatnonzero(fractions)[-1] :] = 1.0  # against rounding: the last split that is not empty reaches 1
    return episodes[np.searchsorted(upper, position, side="right") == SPLITS.index(split)]
