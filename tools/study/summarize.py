"""Collects the results of several runs into docs/results/NAME.json: python summarize.py NAME 'runs/*/results.json'."""

from __future__ import annotations

import glob
import json
import sys
from pathlib import Path

from torchrl_ficreg.evaluation import wilson_interval

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
KEPT = (
    "success_rate",
    "success_interval",
    "success_rate_at_end",
    "solved_at_start",
    "success_rate_unsolved_at_start",
    "seconds_per_plan",
)


def main(name: str, pattern: str) -> None:
    """One entry per run and, per method, the pooled success rate. All runs must share their pairs."""
    runs, pooled, hashes = {}, {}, set()
    for file in sorted(glob.glob(pattern)):
        result = json.loads(Path(file).read_text())
        method, outcome = result["method"], result["policy"]
        hashes.add(outcome["pairs_hash"])
        runs[Path(file).parent.name] = {key: outcome[key] for key in KEPT} | {
            "random": result["random"]["success_rate"],
            "rank_correlation": result["latent_distance"]["rank_correlation"],
            "train_seconds": result["training"]["seconds"],
            "steps": result["training"]["steps"],
            "versions": result["versions"],
        }
        counts = (round(outcome[rate] * outcome["pairs"]) for rate in ("success_rate", "success_rate_at_end"))
        pooled[method] = [sum(pair) for pair in zip(pooled.get(method, (0, 0, 0)), (*counts, outcome["pairs"]))]
    if len(hashes) != 1:
        sys.exit(f"error: {len(runs)} runs on {len(hashes)} sets of pairs; all must share one. Pattern: {pattern}")
    summary = {
        method: {
            "success_rate": solved / total,
            "success_interval": wilson_interval(solved, total),
            "success_rate_at_end": at_end / total,
            "pairs": total,
        }
        for method, (solved, at_end, total) in pooled.items()
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    target = RESULTS / f"{name}.json"
    target.write_text(json.dumps({"pairs_hash": hashes.pop(), "pooled": summary, "runs": runs}, indent=2) + "\n")
    for method, row in summary.items():
        low, high = row["success_interval"]
        sys.stdout.write(
            f"{method}: {row['success_rate']:.1%} ever ({low:.1%} - {high:.1%}), "
            f"{row['success_rate_at_end']:.1%} at the end, of {row['pairs']}\n"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
