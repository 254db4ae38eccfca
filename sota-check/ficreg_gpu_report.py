"""The report of ficreg_gpu.py, ficreg_gpu.json: whole at any moment, whatever ends the slot that writes it."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

Runs = dict[tuple[str, str], Path]  # environment and method -> folder of the run
Results = dict[tuple[str, str], dict[str, Any]]


def planned(result: dict) -> tuple[str, dict]:
    """The method of a ``results.json`` and what its planner reached; earlier ones are keyed by the method's name."""
    method = result.get("method") or next(key for key in result if key in ("ficreg", "lewm", "joint_inverse", "pldm"))
    return method, result["policy"] if "policy" in result else result[method]


def write_report(out: Path, runs: Runs, facts: dict[str, Any]) -> None:
    """Writes what there is so far.

    Args:
        out: folder of the report.
        runs: finished or not.
        facts: further entries of ``ficreg_gpu.json``.

    Raises:
        ValueError: two runs of one environment were evaluated on different pairs.
    """
    results = read_results(runs)
    pairs: dict[str, str] = {}
    for (env, _), result in results.items():
        drawn = planned(result)[1]["pairs_hash"]
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
    """Writes a file so that a kill leaves the old one or the new one, never a half."""
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def read_results(runs: Runs) -> Results:
    """Of the runs that are finished."""
    return {key: json.loads((path / "results.json").read_text()) for key, path in runs.items() if finished(path)}


def finished(run_dir: Path) -> bool:
    """Whether a run was trained and evaluated."""
    return (run_dir / "results.json").exists()


def last_step(run_dir: Path) -> int:
    """The last optimisation step in a run's table, 0 where there is none."""
    rows = read_metrics(run_dir)
    return int(rows[-1]["step"]) if rows else 0


def read_metrics(run_dir: Path) -> list[dict[str, str]]:
    """Rows of a run's metrics.csv, but for a last one that is being written."""
    path = run_dir / "metrics.csv"
    if not path.exists():
        return []
    text = path.read_text()
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
