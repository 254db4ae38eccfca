"""Measures in which row a file stores its actions: the row they lead from, or a neighbouring one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np

LAGS = (-1, 0, 1)

# Fraction of the variance of the state's change. Actions of an unrelated environment explain less than this.
EXPLAINED = 0.1

# Another lag is better when it explains this much more ...
_MARGIN = 0.1
# ... or leaves less than this fraction unexplained. Slow actions fit nearly as well one row off: 0.999 against 0.97.
_REMAINDER = 0.5


class Alignment(NamedTuple):
    """How well the actions explain the change of the state, at each lag.

    Attributes:
        r2: lag -> explained fraction of the variance, at most 1. Lag k pairs the action of row t with the change from
            row t + k to row t + k + 1: 0 is right, -1 means that an action is stored in the row it leads to.
        change: what was explained: the ``"difference"`` of the state, the ``"second difference"``, where actions are
            forces and the state has no velocity, or the ``"target"``, where they are positions to be reached.
        rows: number of rows in the fit.
    """

    r2: dict[int, float]
    change: Literal["difference", "second difference", "target"]
    rows: int

    @property
    def lag(self) -> int | None:
        """The lag at which the actions are stored, or ``None`` where no lag explains anything.

        It is 0 unless another one is clearly better.
        """
        best = max(self.r2, key=self.r2.__getitem__)
        if self.r2[best] < EXPLAINED:
            return None
        margin = self.r2[best] - self.r2[0]
        remainder = (1 - self.r2[best]) / max(1 - self.r2[0], 1e-12)
        clear = margin > _MARGIN or (margin > 0 and remainder < _REMAINDER)
        return best if best and clear else 0


def measure_alignment(episodes: Iterable[tuple[np.ndarray, np.ndarray]]) -> Alignment:
    """Fits, by ridge regression, the change of the state to the actions at lags -1, 0 and 1.

    ::

        s[t+k+1] - s[t+k]  ~  W a[t] + b        k = -1, 0, 1

    Every lag is fitted to its own rows, and the result is the mean over the A state components that the actions explain
    best. Where no lag explains a tenth of their variance, second differences are tried, which is what a force changes,
    and then s[t+k+1] ~ W a[t] + V s[t+k] + b against V alone, for actions that are positions to be reached.

    Args:
        episodes (iterable): pairs of action [L, A] and state [L, S]. Rows with a NaN are left out.

    Returns:
        the first of the three fits that explains something; otherwise that of plain differences.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> action = rng.normal(size=(200, 2))
        >>> state = np.concatenate([np.zeros((1, 2)), action.cumsum(0)[:-1]])  # action t leads from row t
        >>> measure_alignment([(action, state)]).lag
        0
        >>> measure_alignment([(np.roll(action, 1, 0), state)]).lag  # stored in the row it leads to
        -1
    """
    episodes = [(np.asarray(action, float), np.asarray(state, float)) for action, state in episodes]
    first = _fit(episodes, "difference")
    if max(first.r2.values()) >= EXPLAINED:
        return first
    for change in ("second difference", "target"):
        other = _fit(episodes, change)
        if max(other.r2.values()) >= EXPLAINED:
            return other
    return first


def _fit(episodes: list[tuple[np.ndarray, np.ndarray]], change: str) -> Alignment:
    per_lag: dict[int, np.ndarray] = {}
    rows = 0
    for lag in LAGS:
        parts = [_pairs(action, state, lag, change) for action, state in episodes]
        given, known, changed = (np.concatenate(part) for part in zip(*parts))
        rows = max(rows, len(changed))
        base = _residual(known, changed)
        left = _residual(np.concatenate([known, given], 1), changed)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Zero for a component that does not change, whose squares overflow or that has too few rows.
            share = np.where(base > 1e-12 * (1 + (changed**2).sum(0)), 1 - left / base, 0.0)
            per_lag[lag] = np.where(np.isfinite(share), share, 0.0)
    width = min(episodes[0][0].shape[1], episodes[0][1].shape[1])
    best = np.argsort(-np.max(list(per_lag.values()), axis=0))[:width]
    return Alignment({lag: float(r2[best].mean()) for lag, r2 in per_lag.items()}, change, rows)


def _pairs(action: np.ndarray, state: np.ndarray, lag: int, change: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions [n, A], other known inputs [n, K] and the change to explain [n, S], of one episode at one lag."""
    if change == "second difference":
        changed, known = state[2:] - 2 * state[1:-1] + state[:-2], np.zeros((max(len(state) - 2, 0), 0))
        first = 1  # row of the change's start
    else:
        changed = np.diff(state, axis=0)
        known = state[:-1] if change == "target" else np.zeros((len(changed), 0))
        first = 0
    # The action of row t belongs to the change that starts in row t + lag, which has index t + lag - first. The last
    # action leads nowhere and must not count, even where it is a number.
    rows = np.arange(len(action) - 1)
    place = rows + lag - first
    inside = (place >= 0) & (place < len(changed))
    given, known, changed = action[rows[inside]], known[place[inside]], changed[place[inside]]
    finite = np.isfinite(given).all(1) & np.isfinite(changed).all(1) & np.isfinite(known).all(1)
    return given[finite], known[finite], changed[finite]


def _residual(inputs: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Residual sum of squares [S] of a ridge regression, corrected for its number of inputs."""
    count = len(outputs)
    freedom = count - inputs.shape[1] - 1
    if freedom < 1:
        return np.full(outputs.shape[1], np.nan)
    outputs = outputs - outputs.mean(0)
    scale = inputs.std(0)
    inputs = (inputs - inputs.mean(0)) / np.where(scale > 0, scale, 1.0)
    gram = inputs.T @ inputs + 1e-6 * count * np.eye(inputs.shape[1])
    left = outputs - inputs @ np.linalg.solve(gram, inputs.T @ outputs)
    return (left**2).sum(0) / freedom * (count - 1)
