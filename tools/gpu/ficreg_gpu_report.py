"""The report of ficreg_gpu.py, ficreg_gpu.json, written atomically."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

Runs = dict[tuple[str, str], Path]  # environment and method -> folder of the run
Results = dict[tuple[str, str], dict[str, Any]]


def write_report(out: Path, runs: Runs, facts: dict[str, Any]) -> None:
    """Writes the report of the finished runs.

    Args:
        out: folder of the report.
        runs: all runs, finished or not.
        facts: further entries of ``ficreg_gpu.json``.

    Raises:
        ValueError: two runs of one environment were evaluated on different pairs.
    """
    results = read_results(runs)
    pairs: dict[str, str] = {}
    for (env, _), result in results.items():
        drawn = result["policy"]["pairs_hash"]
        if pairs.setdefault(env, drawn) != drawn:
            raise ValueError(f"the runs of {env} were evaluated on different pairs: remove one of {sorted(runs.values())}.")
    content = {
        **facts,
        "pairs_hash": pairs,
        "results": {f"{env}_{method}": result for (env, method), result in results.items()},
        "unfinished": {path.name: last_step(path) for path in runs.values() if not finished(path)},
    }
    write_whole(out / "ficreg_gpu.json", json.dumps(content, indent=2) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Writes a file atomically: after a kill it holds the old text or the new one."""
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def read_results(runs: Runs) -> Results:
    """Results of the finished runs."""
    return {key: json.loads((path / "results.json").read_text()) for key, path in runs.items() if finished(path)}


def finished(run_dir: Path) -> bool:
    """Whether a run was trained and evaluated."""
    return (run_dir / "results.json").exists()


def last_step(run_dir: Path) -> int:
    """The last step in a run's metrics.csv, 0 without one."""
    rows = read_metrics(run_dir)
    return int(rows[-1]["step"]) if rows else 0


def read_metrics(run_dir: Path) -> list[dict[str, str]]:
    """Complete rows of a run's metrics.csv."""
    path = run_dir / "metrics.csv"
    if not path.exists():
        return []
    text = path.read_text()
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
