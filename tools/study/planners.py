"""Success rate against planning time of every planner, on trained runs: docs/results/planners.{json,png}.

    python tools/study/planners.py runs/two_room_cpu_ficreg_seed0 runs/push_t_cpu_ficreg_seed0

Each planner is evaluated by evaluate.py on the run's own frozen pairs. The goal-conditioned policy is trained first if missing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "sota-implementations" / "ficreg"
FRAME_SKIP = 5  # environment steps in an action block
SEARCHES = {
    "CEM 300 x 30": ["plan=cem", "plan.iterations=30"],
    "CEM 300 x 10": ["plan=cem"],
    "iCEM 100 x 10": ["plan=icem"],
    "MPPI 300 x 10": ["plan=mppi"],
    "gradient 16 x 30": ["plan=gradient"],
    "shooting 300 x 10": ["plan=shooting"],
    "policy": ["plan=policy"],
    "iCEM 100 x 5 + policy": ["plan=icem", "plan.iterations=5", "plan.policy=auto"],
    "CEM 300 x 10, consistency cost": ["plan=cem", "plan.consistency=0.1"],
    "CEM 300 x 10, receding horizon 1": ["plan=cem", "plan.receding_horizon=1"],
}


def main() -> None:
    """Evaluates, collects, draws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--only", nargs="*", help="prefixes of the names of the planners; default: all")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "planners.json")
    parser.add_argument("--override", nargs="*", default=[], help="further settings of evaluate.py")
    arguments = parser.parse_args()
    names = [n for n in SEARCHES if not arguments.only or n.startswith(tuple(arguments.only))]
    tables = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for run in arguments.runs:
        if not (run / "goal_policy").exists() and any("policy" in name for name in names):
            call("train_policy.py", f"checkpoint={run}")
        table = tables.setdefault(run.name, {})
        for name in names:
            table[name] = evaluate(run, [*SEARCHES[name], *arguments.override])
            print(
                f"{run.name:<32}{name:<26}{table[name]['success_rate']:>8.1%} ever"
                f"{table[name]['success_rate_at_end']:>8.1%} at the end{table[name]['seconds']:>9.3f} s"
            )
            arguments.out.write_text(json.dumps(tables, indent=2) + "\n")
    draw(tables, arguments.out.with_suffix(".png"))


def evaluate(run: Path, overrides: list[str]) -> dict:
    """Success on the frozen pairs, and seconds of planning in one episode."""
    with tempfile.TemporaryDirectory() as folder:
        call("evaluate.py", f"checkpoint={run}", f"output={folder}", "record=0", *overrides)
        (file,) = Path(folder).glob("*/results.json")
        results = json.loads(file.read_text())
    outcome, plan = results["policy"], results["plan"]
    steps = plan["receding_horizon"] * FRAME_SKIP
    return {
        "success_rate": outcome["success_rate"],
        "success_interval": outcome["success_interval"],
        "success_rate_at_end": outcome["success_rate_at_end"],
        "random": results["random"]["success_rate"],
        "seconds_per_plan": outcome["seconds_per_plan"],
        "seconds": outcome["seconds_per_plan"] * -(-outcome["budget"] // steps),
        "pairs_hash": outcome["pairs_hash"],
        "plan": plan,
        "versions": results["versions"],
    }


def call(script: str, *overrides: str) -> None:
    """Runs a script of the recipe; raises with its output when it fails."""
    done = subprocess.run([sys.executable, str(SCRIPTS / script), *overrides], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{script} {' '.join(overrides)} failed:\n{done.stderr[-2000:]}")


def draw(tables: dict, target: Path) -> None:
    """One panel for each run: goals ever reached (filled) and reached at the end over seconds of planning in an episode."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(tables), figsize=(6.2 * len(tables), 4.2), squeeze=False)
    for axis, (run, table) in zip(axes[0], tables.items()):
        for name, row in table.items():
            low, high = row["success_interval"]
            rate = row["success_rate"]
            marks = axis.errorbar(row["seconds"], rate, [[max(0.0, rate - low)], [max(0.0, high - rate)]], fmt="o", capsize=2, lw=0.8)
            axis.plot(row["seconds"], row["success_rate_at_end"], "o", mfc="none", color=marks[0].get_color())
            axis.annotate(name, (row["seconds"], rate), xytext=(6, 4), textcoords="offset points", fontsize=7)
        axis.axhline(next(iter(table.values()))["random"], color="grey", ls=":", lw=1)
        axis.set(title=run, xscale="log", xlabel="seconds of planning in an episode", ylabel="success: ever (filled), at the end", ylim=(0, 1.05))
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(target, dpi=110)


if __name__ == "__main__":
    main()
