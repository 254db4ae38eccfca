"""Plots of a run and a GIF of its episodes. Needs the ``plot`` extra (matplotlib and imageio)."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from pathlib import Path

import numpy as np

from torchrl_ficreg._utils import read_bytes, require, write_atomic
from torchrl_ficreg.evaluation.metrics import DistanceProfile
from torchrl_ficreg.evaluation.mpc import Evaluation


def _pyplot():
    require("matplotlib", "plot", purpose="a picture").use("Agg")
    return require("matplotlib.pyplot", "plot", purpose="a picture", package="matplotlib")


def plot_learning_curve(metrics: Path, target: Path) -> None:
    """Plots every loss term of a ``metrics.csv`` on a logarithmic axis: training as a line, validation as dots.

    Terms that are zero throughout, as SIGReg is in a training on latents, are left out.

    Args:
        metrics (Path): the table of an :class:`~torchrl_ficreg.trainers.OfflineTrainer`.
        target (Path): PNG file to write.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: the table holds no loss, or is damaged.
    """
    pyplot = _pyplot()
    curves: dict[str, dict[str, list[tuple[int, float]]]] = defaultdict(lambda: defaultdict(list))
    try:
        for row in csv.DictReader(read_bytes(metrics).decode().splitlines()):
            for key, value in row.items():
                if key is not None and key.startswith("loss_") and value:
                    curves[key][row["split"]].append((int(row["step"]), float(value)))
    except (csv.Error, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{metrics} is damaged ({str(error)[:80]}): restore it, or move it away.") from error
    curves = {term: splits for term, splits in curves.items() if any(value for rows in splits.values() for _, value in rows)}
    if not curves:
        raise ValueError(f"{metrics} holds no loss: give the metrics.csv of a run that has begun to train.")
    figure, axes = pyplot.subplots(1, len(curves), figsize=(3.4 * len(curves), 2.8), squeeze=False)
    for axis, (term, splits) in zip(axes[0], sorted(curves.items())):
        for split, style in (("train", {"lw": 1}), ("validation", {"marker": "o", "ls": "", "ms": 4})):
            if splits[split]:
                axis.plot(*zip(*splits[split]), label=split, **style)
        axis.set(title=term, xlabel="step", yscale="log")
        axis.grid(alpha=0.3)
    axes[0][0].legend()
    _save(figure, target)


def plot_latent_distance(profile: DistanceProfile, target: Path, unit: str = "state distance") -> None:
    """Plots latent distance against true distance: median and 10-90 % band over pairs of held-out frames.

    A planner that minimises latent distance makes progress where this curve rises, and none where it is flat.

    Args:
        profile (DistanceProfile): the distances, see :func:`~torchrl_ficreg.evaluation.latent_distance`.
        target (Path): PNG file to write.
        unit (str, optional): axis label of the true distance. Default: ``"state distance"``.

    Raises:
        ImportError: matplotlib is missing.
    """
    pyplot = _pyplot()
    center, quantiles = profile.bins(count=24)
    figure, axis = pyplot.subplots(figsize=(4.5, 3.4))
    axis.fill_between(center, quantiles[:, 0], quantiles[:, 2], alpha=0.25, label="10-90 %")
    axis.plot(center, quantiles[:, 1], label="median")
    axis.set(xlabel=unit, ylabel="latent distance", xlim=(0, None), ylim=(0, None))
    axis.set_title(f"rank correlation {profile.rank_correlation:.2f}")
    axis.grid(alpha=0.3)
    axis.legend()
    _save(figure, target)


def save_episodes_gif(evaluation: Evaluation, target: Path, *, scale: int = 2, fps: int = 10, columns: int = 4) -> None:
    """Writes a GIF of the recorded episodes, each beside its goal image; the border turns green on success.

    Args:
        evaluation (Evaluation): an evaluation with recorded episodes.
        target (Path): GIF file to write.

    Keyword Args:
        scale (int, optional): factor by which images are enlarged. Default: ``2``.
        fps (int, optional): frames per second. Default: ``10``.
        columns (int, optional): number of episodes in a row. Default: ``4``.

    Raises:
        ImportError: imageio is missing.
        ValueError: no episode was recorded.
    """
    imageio = require("imageio.v3", "plot", purpose="a GIF", package="imageio")
    if not evaluation.frames:
        raise ValueError("no episode was recorded: evaluate with record=4, say.")
    reached = np.maximum.accumulate(evaluation.success, axis=1)
    pictures = []
    for step in range(len(evaluation.frames[0])):
        tiles = [
            _tile(frames[step], goal, bool(reached[row, step]), scale)
            for row, frames, goal in zip(evaluation.recorded, evaluation.frames, evaluation.goals)
        ]
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
        rows = [np.concatenate(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
        pictures.append(np.concatenate(rows))
    pictures += [pictures[-1]] * fps  # one second of the last frame
    movie = imageio.imwrite("<bytes>", np.stack(pictures), extension=".gif", duration=1000 // fps, loop=0)
    write_atomic(target, movie)


def _tile(frame: np.ndarray, goal: np.ndarray, reached: bool, scale: int) -> np.ndarray:
    """Image and goal image [3, H, W] -> bordered picture [h, w, 3]."""
    pair = np.concatenate([frame, goal], axis=2).transpose(1, 2, 0).repeat(scale, 0).repeat(scale, 1)
    color = (40, 160, 70) if reached else (190, 190, 190)
    framed = np.full((pair.shape[0] + 8, pair.shape[1] + 8, 3), 255, dtype=np.uint8)
    framed[1:-1, 1:-1] = color
    framed[4:-4, 4:-4] = pair
    return framed


def _save(figure, target: Path) -> None:
    figure.tight_layout()
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120)
    _pyplot().close(figure)
    write_atomic(target, drawn.getvalue())
