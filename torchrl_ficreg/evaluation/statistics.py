"""Honest numbers for success rates."""

from __future__ import annotations

import math

import numpy as np


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Confidence interval of a proportion (Wilson, 1927), 95 % by default.

    Unlike mean plus or minus two standard errors it stays inside [0, 1] and has a width at 0 and at 100 %.

    Examples:
        >>> low, high = wilson_interval(85, 100)
        >>> round(low, 3), round(high, 3)
        (0.767, 0.907)
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must lie between 0 and trials, got {successes} of {trials}.")
    if trials == 0:
        return 0.0, 1.0
    share, square = successes / trials, z**2 / trials
    center = (share + square / 2) / (1 + square)
    half = z * math.sqrt(share * (1 - share) / trials + square / (4 * trials)) / (1 + square)
    return max(0.0, center - half), min(1.0, center + half)


def rank_correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Spearman's rank correlation of two samples [N]; equal values share their mean rank.

    0 where one sample is constant, for then there is nothing to follow.

    Examples:
        >>> float(rank_correlation(np.array([1.0, 2.0, 5.0]), np.array([0.0, 3.0, 4.0])))
        1.0
    """
    ranks = []
    for values in (first, second):
        _, which, count = np.unique(values, return_inverse=True, return_counts=True)
        if len(count) == 1:
            return 0.0
        ranks.append((np.cumsum(count) - (count - 1) / 2)[which])
    return float(np.corrcoef(*ranks)[0, 1])
