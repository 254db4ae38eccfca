"""Trains and evaluates LeWM and FICReg on TwoRoom and PushT within a time slot; called by run_ficreg_gpu.sh.

Each run is a process of train.py, which records episodes, trains, plans on frozen pairs and can be stopped at any time. At the end
of the slot the current run is stopped; the same command continues it in the next slot. The report is updated every minute and
after every run, so that a killed slot leaves one.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from ficreg_gpu_report import finished, Runs, write_report, write_whole

ROOT = Path(__file__).resolve().parents[2]
TRAIN = ROOT / "sota-implementations" / "ficreg" / "train.py"
ENVIRONMENTS, METHODS = ("two_room", "push_t"), ("lewm", "ficreg")
TIME_IS_UP = 75  # exit code; EX_TEMPFAIL of sysexits.h
REPORT_SECONDS = 60.0  # of a slot, reserved for the profile and the figures
STOP_SECONDS = 45.0  # that a stopped run may take to write its checkpoint
REFRESH = 60.0  # seconds between reports
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # opened before any fork
PR_SET_PDEATHSIG = 1

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
    """Continues or starts the unfinished runs, then writes the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True, help="folder of episodes and runs")
    parser.add_argument("--out", type=Path, required=True, help="folder of the report")
    parser.add_argument("--minutes", type=float, help="length of the slot; 10, or an hour for --dry-run")
    parser.add_argument("--began", type=float, default=time.time(), help="when the slot began, seconds since 1970")
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes, on the CPU")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, end_slot)
    minutes = arguments.minutes if arguments.minutes is not None else 60.0 if arguments.dry_run else 10.0
    began = time.monotonic() - max(0.0, time.time() - arguments.began)
    stop_at = began + 60 * minutes - (0.0 if arguments.dry_run else REPORT_SECONDS)
    runs = {(env, method): arguments.work / "runs" / f"{env}_{method}" for env in ENVIRONMENTS for method in METHODS}
    slot = Slot(arguments.work, arguments.out, runs, began)
    slot.report()
    try:
        with open(arguments.out / "log.txt", "a") as log:
            for env, method in runs:
                if not go_on(arguments, env, method, stop_at, log, slot):
                    slot.failed.append(f"{env}_{method}")
                slot.report()
        profile_once(arguments, next((path for path in runs.values() if finished(path)), None))
    finally:
        slot.report()
    slot.draw()
    slot.report()  # with the time of the figures
    if slot.failed:
        print(f"error: {', '.join(slot.failed)} failed; see {arguments.out / 'log.txt'}", file=sys.stderr)
        return 1
    print(f"report in {arguments.out}" if slot.complete else "time is up: the same command continues", flush=True)
    return 0 if slot.complete else TIME_IS_UP


def end_slot(*_: object) -> None:
    """Handles the first SIGTERM; later ones are ignored, so that the report is written completely."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(TIME_IS_UP)


class Slot:
    """State of a time slot, and its report.

    Args:
        work: folder of the lengths of all slots and of the profile.
        out: folder of the report.
        runs: all runs, finished or not.
        began: start of the slot on the monotonic clock, s.
    """

    def __init__(self, work: Path, out: Path, runs: Runs, began: float) -> None:
        self.work, self.out, self.runs, self.began = work, out, runs, began
        self.failed: list[str] = []
        self.before = json.loads((work / "slots.json").read_text()) if (work / "slots.json").exists() else []

    @property
    def complete(self) -> bool:
        """Whether every run is finished."""
        return all(finished(path) for path in self.runs.values())

    @property
    def profile(self) -> dict[str, Any] | None:
        """Profile of a training step, None before it was measured."""
        path = self.work / "profile.json"
        return json.loads(path.read_text()) if path.exists() else None

    def report(self) -> None:
        """Updates the length of this slot and the report."""
        slots = [*self.before, round(time.monotonic() - self.began, 1)]
        write_whole(self.work / "slots.json", json.dumps(slots))
        facts = {"complete": self.complete, "failed": self.failed, "slots": slots, "profile": self.profile}
        write_report(self.out, self.runs, facts)

    def draw(self) -> None:
        """Draws the figures; prints a line if matplotlib is missing."""
        try:
            from ficreg_gpu_pictures import draw_pictures
        except ImportError as error:
            print(f"pictures are skipped: {error}", flush=True)
            return
        draw_pictures(self.out, self.runs, self.profile)


def go_on(arguments: argparse.Namespace, env: str, method: str, stop_at: float, log: Any, slot: Slot) -> bool:
    """Starts or continues an unfinished run if time is left; false if it failed."""
    name = f"{env}_{method}"
    left = stop_at - time.monotonic()
    if finished(slot.runs[env, method]) or left <= 0:
        return True
    command = [sys.executable, str(TRAIN), f"env={env}", f"method={method}", "model=gpu_short", f"name={name}"]
    command += [f"runs_dir={arguments.work / 'runs'}", f"data_dir={arguments.work / 'data'}"]
    command += TINY if arguments.dry_run else [f"collect.num_workers={len(os.sched_getaffinity(0))}"]
    print(f"{name}, {left:.0f} s left", flush=True)
    print(f"\n$ {' '.join(command)}", file=log, flush=True)
    quiet = {**os.environ, "TQDM_MININTERVAL": "10"}  # seconds between lines of a progress bar
    bound = functools.partial(die_with, os.getpid())
    process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=quiet, preexec_fn=bound)
    try:
        while process.poll() is None and (left := stop_at - time.monotonic()) > 0:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(min(left, REFRESH))
            slot.report()
        return process.poll() in (None, 0)
    finally:
        stop(process)


def die_with(parent: int) -> None:
    """Called in a new process before its program: requests SIGTERM from the kernel when the parent process ends."""
    if LIBC is not None:
        LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # gone already
            os._exit(1)


def stop(process: subprocess.Popen) -> None:
    """Sends SIGTERM, on which train.py writes a checkpoint, and SIGKILL after ``STOP_SECONDS``."""
    if process.poll() is None:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(STOP_SECONDS)
        process.kill()
        process.wait()


def profile_once(arguments: argparse.Namespace, run_dir: Path | None) -> None:
    """Profiles a training step of a finished run, unless there is a profile."""
    path = arguments.work / "profile.json"
    if run_dir is not None and not path.exists():
        from step_profile import profile  # torch, which takes seconds to import

        write_whole(path, json.dumps(profile(run_dir, steps=1 if arguments.dry_run else 50)))


if __name__ == "__main__":
    sys.exit(main())
