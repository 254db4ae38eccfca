"""Figures of the report of ficreg_gpu.py."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import matplotlib
from ficreg_gpu_report import finished, read_metrics, read_results, Runs

matplotlib.use("Agg")
from matplotlib import pyplot

COLORS = {"lewm": "tab:gray", "ficreg": "tab:blue"}


def draw_pictures(out: Path, runs: Runs, profile: dict[str, Any] | None) -> None:
    """Draws the figures of the finished runs.

    Args:
        out: folder of the report.
        runs: all runs, finished or not.
        profile: of a training step.
    """
    results = read_results(runs)
    if results:
        draw_success(results, out / "success.png")
    draw_training(runs, out / "training.png")
    if profile:
        draw_profile(profile, out / "profile.png")
    for (env, method), path in runs.items():
        if method == "ficreg" and finished(path) and (path / "episodes.gif").exists():
            shutil.copy(path / "episodes.gif", out / f"{env}.gif")


def draw_success(results: dict[tuple[str, str], dict[str, Any]], target: Path) -> None:
    """Shares of goals ever reached with 95 % intervals, and reached at the end (dots); the random baseline as a line."""
    environments = sorted({env for env, _ in results})
    figure, axes = pyplot.subplots(1, len(environments), figsize=(3.2 * len(environments), 3.2), squeeze=False)
    for axis, env in zip(axes[0], environments):
        for place, (method, color) in enumerate(COLORS.items()):
            if (env, method) not in results:
                continue
            outcome, random = results[env, method]["policy"], results[env, method]["random"]
            low, high = outcome["success_interval"]
            rate = outcome["success_rate"]
            axis.bar(place, rate, color=color, yerr=[[rate - low], [high - rate]], capsize=4)
            axis.plot(place, outcome["success_rate_at_end"], "o", color="white", markeredgecolor="black")
            axis.axhline(random["success_rate"], color="black", ls=":", lw=1)
        axis.set(title=env, xticks=range(len(COLORS)), xticklabels=COLORS, ylim=(0, 1), ylabel="success rate")
    save(figure, target)


def draw_training(runs: Runs, target: Path) -> None:
    """Prediction loss against the step, a panel per environment."""
    environments = sorted({env for env, _ in runs})
    figure, axes = pyplot.subplots(1, len(environments), figsize=(4 * len(environments), 3.2), squeeze=False)
    for axis, env in zip(axes[0], environments):
        for method, color in COLORS.items():
            rows = [row for row in read_metrics(runs[env, method]) if row["split"] == "train" and row["loss_pred"]]
            axis.plot(
                [int(row["step"]) for row in rows], [float(row["loss_pred"]) for row in rows], label=method, color=color
            )
        axis.set(title=env, xlabel="step", ylabel="prediction loss", yscale="log")
        axis.legend()
    save(figure, target)


def draw_profile(profile: dict[str, Any], target: Path) -> None:
    """Share of each kernel in a step, with the main numbers in the title."""
    names = list(profile["kernels"])[::-1]
    figure, axis = pyplot.subplots(figsize=(8, 4))
    axis.barh([name[:50] for name in names], [profile["kernels"][name] for name in names], color="tab:blue")
    axis.set_xlabel("share of a step")
    axis.set_title(
        f"{profile['device']}: {1e3 * profile['step_seconds']:.1f} ms a step, {profile['share_of_peak']:.0%} of the "
        f"{profile['dtype']} peak, loader {profile['loader_share']:.0%}",
        fontsize=9,
    )
    save(figure, target)


def save(figure: Any, target: Path) -> None:
    """Saves a figure and closes it."""
    figure.tight_layout()
    figure.savefig(target, dpi=110)
    pyplot.close(figure)
