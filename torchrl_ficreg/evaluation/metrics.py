"""Confidence intervals of success rates, rank correlation, and latent distance against true distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.keys import PIXELS, STATE
from torchrl_ficreg.modules.world_model import LatentWorldModel


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Confidence interval of a proportion (Wilson, 1927).

    Unlike the mean plus or minus two standard errors, it lies within [0, 1] and is not empty at 0 and 100 %.

    Args:
        successes (int): number of successes.
        trials (int): number of trials.
        z (float, optional): quantile of the normal distribution. Default: ``1.959964``, for 95 %.

    Returns:
        lower and upper bound; (0, 1) without any trial.

    Raises:
        ValueError: ``successes`` is negative or exceeds ``trials``.

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
    """Spearman's rank correlation; equal values share their mean rank.

    Args:
        first (np.ndarray): sample [N].
        second (np.ndarray): sample [N].

    Returns:
        the correlation in [-1, 1]; 0 if one sample is constant.

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


@dataclass
class DistanceProfile:
    """True and latent distances of pairs of frames.

    Attributes:
        true (np.ndarray): Euclidean distances of simulator states [P], in the unit of the state.
        latent (np.ndarray): Euclidean distances of latents [P].
    """

    true: np.ndarray
    latent: np.ndarray

    @property
    def rank_correlation(self) -> float:
        """Spearman's rank correlation over all pairs."""
        return rank_correlation(self.true, self.latent)

    def bins(self, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
        """Quantiles of the latent distance within bins of true distance.

        Args:
            count (int, optional): number of bins with equally many pairs; empty ones are left out. Default: ``12``.

        Returns:
            mean true distance [count] and 10th, 50th and 90th percentile of the latent distance [count, 3].
        """
        edges = np.quantile(self.true, np.linspace(0, 1, count + 1))
        which = np.clip(np.searchsorted(edges, self.true, side="right") - 1, 0, count - 1)
        kept = [index for index in range(count) if (which == index).any()]
        center = np.array([self.true[which == index].mean() for index in kept])
        quantiles = np.array([np.quantile(self.latent[which == index], (0.1, 0.5, 0.9)) for index in kept])
        return center, quantiles

    def summary(self) -> dict[str, Any]:
        """JSON values: rank correlation and binned distances; None and empty lists if a distance is not finite."""
        if not (np.isfinite(self.true).all() and np.isfinite(self.latent).all()):
            return {"rank_correlation": None, "true_distance": [], "median_latent_distance": []}
        center, quantiles = self.bins()
        return {
            "rank_correlation": self.rank_correlation,
            "true_distance": center.round(3).tolist(),
            "median_latent_distance": quantiles[:, 1].round(4).tolist(),
        }


@torch.no_grad()
def latent_distance(
    model: LatentWorldModel, dataset: OfflineTrajectories, *, num_frames: int = 400, seed: int = 0
) -> DistanceProfile:
    """Measures true and latent distance for all pairs of some held-out frames.

    Args:
        model (LatentWorldModel): world model, in eval mode.
        dataset (OfflineTrajectories): held-out episodes with states.

    Keyword Args:
        num_frames (int, optional): number of frames drawn; all frames if there are fewer. Default: ``400``.
        seed (int, optional): seed of the draw. Default: ``0``.

    Raises:
        ValueError: fewer than two frames, or episodes without states.
    """
    dataset.store.require_state()
    table = dataset.episodes
    ends = table["length"].cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    if min(num_frames, total) < 2:
        raise ValueError(f"distances need two frames at least, got num_frames={num_frames} of {total} held-out ones.")
    picks = np.sort(np.random.default_rng(seed).choice(total, min(num_frames, total), replace=False))
    rows = torch.searchsorted(ends, torch.from_numpy(picks), right=True)
    steps = torch.from_numpy(picks) - (ends - table["length"])[rows]
    places = [(int(table["episode"][r]), slice(int(s), int(s) + 1)) for r, s in zip(rows, steps)]
    frames = [dataset.episode_data(episode, steps=step)[0] for episode, step in places]
    state = torch.stack([frame[STATE] for frame in frames])  # [N, S]
    device = model.action_mean.device
    chunks = torch.stack([frame[PIXELS] for frame in frames]).split(64)
    latent = torch.cat([model.encode(chunk.to(device)).float().cpu() for chunk in chunks])  # [N, D]
    first, second = torch.triu_indices(len(frames), len(frames), offset=1)
    true = (state[first] - state[second]).norm(dim=-1).numpy()
    return DistanceProfile(true, (latent[first] - latent[second]).norm(dim=-1).numpy())
