"""Trains and evaluates LeWM and FICReg on TwoRoom and PushT within a slot of time; run_ficreg_gpu.sh calls it.

Each run is train.py in a process of its own, which records episodes, trains, plans on frozen pairs and can be stopped
at any moment. When time is up the one at work is stopped; the same command continues with it in the next slot.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from ficreg_gpu_report import write_report

ROOT = Path(__file__).resolve().parents[1]
TRAIN = ROOT / "sota-implementations" / "ficreg" / "train.py"
ENVIRONMENTS, METHODS = ("two_room", "push_t"), ("lewm", "ficreg")
TIME_IS_UP = 75  # exit code; EX_TEMPFAIL of sysexits.h
REPORT_SECONDS = 60.0  # of a slot, kept for the profile and the pictures
PATIENCE = 45.0  # seconds that a stopped run may take to write its checkpoint

TINY = [
    "device=cpu",
    "env.data.episodes=20",
    "env.data.max_steps=25",
    "model.image_size=28",
    "model.predictor_depth=1",
    "model.predictor_mlp_dim=32",
    "model.predictor_projector_dim=32",
    "model.encoder_projector_dim=32",
    "optim.epochs=1",
    "optim.batch_size=32",
    "optim.validation_batches=1",
    "logger.interval=1",
    "collect.num_workers=0",
    "evaluation.num_pairs=2",
    "evaluation.record=1",
    "env.goal_offset=5",
    "env.budget=5",
    "plan.horizon=1",
    "plan.receding_horizon=1",
    "plan.iterations=1",
    "plan.num_candidates=8",
    "plan.num_elites=4",
]


def main() -> int:
    """Goes on with what is missing, then reports what is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True, help="episodes and runs")
    parser.add_argument("--out", type=Path, required=True, help="the report")
    parser.add_argument("--minutes", type=float, help="length of the slot; 10, or an hour for --dry-run")
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes, on the CPU")
    arguments = parser.parse_args()
    minutes = arguments.minutes if arguments.minutes is not None else 60.0 if arguments.dry_run else 10.0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TIME_IS_UP))
    began = time.monotonic()
    stop_at = began + 60 * minutes - (0.0 if arguments.dry_run else REPORT_SECONDS)
    runs = {(env, method): arguments.work / "runs" / f"{env}_{method}" for env in ENVIRONMENTS for method in METHODS}
    with open(arguments.out / "log.txt", "a") as log:
        failed = [where.name for (env, method), where in runs.items() if not go_on(arguments, env, method, stop_at, log)]
    complete = all((where / "results.json").exists() for where in runs.values())
    slots = note_slot(arguments.work / "slots.json", time.monotonic() - began)
    profile = profile_once(arguments, next((where for where in runs.values() if (where / "results.json").exists()), None))
    write_report(arguments.out, runs, {"complete": complete, "failed": failed, "slots": slots, "profile": profile})
    if failed:
        print(f"error: {', '.join(failed)} failed; the reasons are in {arguments.out / 'log.txt'}", file=sys.stderr)
        return 1
    print(f"report in {arguments.out}" if complete else "time is up: the same command continues", flush=True)
    return 0 if complete else TIME_IS_UP


def go_on(arguments: argparse.Namespace, env: str, method: str, stop_at: float, log: Any) -> bool:
    """Starts or continues a run where it is not finished and time is left; false where it failed by itself."""
    name = f"{env}_{method}"
    left = stop_at - time.monotonic()
    if (arguments.work / "runs" / name / "results.json").exists() or left <= 0:
        return True
    command = [sys.executable, str(TRAIN), f"env={env}", f"method={method}", "model=gpu_short", f"name={name}"]
    command += [f"runs_dir={arguments.work / 'runs'}", f"data_dir={arguments.work / 'data'}"]
    command += TINY if arguments.dry_run else [f"collect.num_workers={os.cpu_count()}"]
    print(f"{name}, {left:.0f} s left", flush=True)
    print(f"\n$ {' '.join(command)}", file=log, flush=True)
    quiet = {**os.environ, "TQDM_MININTERVAL": "10"}  # seconds between lines of a progress bar
    process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=quiet)
    try:
        return process.wait(left) == 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        stop(process)


def stop(process: subprocess.Popen) -> None:
    """Asks a process to end, which makes train.py write what it has, and ends it if it does not."""
    if process.poll() is None:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE)
        process.kill()
        process.wait()


def note_slot(path: Path, seconds: float) -> list[float]:
    """Adds the length of this slot to those before and returns all."""
    slots = json.loads(path.read_text()) if path.exists() else []
    slots.append(round(seconds, 1))
    path.write_text(json.dumps(slots))
    return slots


def profile_once(arguments: argparse.Namespace, run_dir: Path | None) -> dict[str, Any] | None:
    """The profile of a finished run's training step; measured in the first slot that has one."""
    path = arguments.work / "profile.json"
    if run_dir is not None and not path.exists():
        from step_profile import profile  # torch, which takes seconds to import

        path.write_text(json.dumps(profile(run_dir, steps=1 if arguments.dry_run else 50)))
    return json.loads(path.read_text()) if path.exists() else None


if __name__ == "__main__":
    sys.exit(main())
