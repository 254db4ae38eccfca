"""Whatever fails around a run, it stops or goes on as documented, and the last good state is whole.

Every fault is a real one: the system refuses to let a file grow, files are cut or removed, processes are killed.
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress

import pytest
import torch
from test_killed_runs import half_written
from tiny import make_trainer, record, run_until_told, same, weights
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint
from torchrl.record.loggers import get_logger
from torchrl.trainers import Trainer

from torchrl_ficreg.data import EpisodeWriter, OfflineTrajectories
from torchrl_ficreg.trainers import (
    find_checkpoint,
    load_world_model,
    Preempted,
    PREEMPTED,
    ReadError,
    stop_on_signal,
    SuccessRate,
    TolerantLogger,
)


@pytest.fixture(scope="module")
def unbroken():
    """Weights of a run that nothing happened to."""
    trainer = make_trainer()
    trainer.train()
    return weights(trainer)


@pytest.fixture
def warnings(monkeypatch):
    """Every warning of the run."""
    said = []
    monkeypatch.setattr(torchrl_logger, "warning", lambda text, *_: said.append(text))
    return said


@contextmanager
def no_file_may_exceed(size: int):
    """What a full disk does to a growing file: a part is written, the rest is an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def at_step(trainer, step: int, action) -> None:
    """Does something between two steps."""
    trainer.register_op("post_steps", lambda: action() if trainer.step == step else None)


def steps(run_dir) -> list[int]:
    rows = csv.DictReader((run_dir / "metrics.csv").read_text().splitlines())
    return [int(row["step"]) for row in rows if row["split"] == "train"]


@pytest.mark.parametrize("size", [2_000, 20_000], ids=["under the weights", "under the archive"])
def test_a_disk_that_fills_up_while_a_checkpoint_is_written_stops_the_run(tmp_path, unbroken, size):
    """The checkpoint before is whole, nothing half-written stays, and the same command ends with the same weights."""
    trainer, limits = make_trainer(tmp_path, log_interval=100), resource.getrlimit(resource.RLIMIT_FSIZE)
    at_step(trainer, 17, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1])))
    with no_file_may_exceed(limits[0]), pytest.raises(OSError, match="step 18 cannot be written .*make room"):
        trainer.train()
    assert not half_written(tmp_path)
    load_world_model(tmp_path)
    again = make_trainer(tmp_path, log_interval=100)
    assert again.resume() and again.step == 9
    again.train()
    assert same(weights(again), unbroken)


def test_a_disk_that_is_nearly_full_is_noticed_before_anything_is_written(tmp_path, monkeypatch):
    """A memory map that outgrows its disk is SIGBUS, so room is asked for first."""
    import shutil

    trainer = make_trainer(tmp_path, epochs=1)
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    at_step(trainer, 8, lambda: monkeypatch.setattr(shutil, "disk_usage", lambda place: full))
    with pytest.raises(OSError, match="no room for a checkpoint .* MB needed"):
        trainer.train()
    assert not list((tmp_path / "checkpoints").iterdir())


def test_room_is_asked_for_only_when_a_checkpoint_is_due(tmp_path, monkeypatch):
    """A disk that is full between two checkpoints stops nothing; one look for each of the three that are written."""
    import shutil

    looks, disk_usage = [], shutil.disk_usage
    trainer = make_trainer(tmp_path)

    def look(place):
        looks.append(trainer.step)
        return disk_usage(place) if trainer.step % 9 == 0 else disk_usage(place)._replace(free=0)

    monkeypatch.setattr(shutil, "disk_usage", look)
    trainer.train()
    assert looks == [9, 18, 27]


def test_rows_of_metrics_wait_until_there_is_room(tmp_path, unbroken, warnings):
    """One warning; half a row is taken back at once; in the end no row is missing and the weights are the same."""
    trainer = make_trainer(tmp_path, log_interval=1)
    table, limits = tmp_path / "metrics.csv", resource.getrlimit(resource.RLIMIT_FSIZE)
    whole = []

    def fill() -> None:
        whole.append(table.read_bytes())
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole[0]) + 20, limits[1]))

    def free() -> None:
        assert table.read_bytes() == whole[0]
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    at_step(trainer, 2, fill)
    at_step(trainer, 6, free)
    with no_file_may_exceed(limits[0]):
        trainer.train()
    assert len(warnings) == 1 and "rows wait in memory" in warnings[0]
    assert steps(tmp_path) == [*range(1, 28)]
    assert same(weights(trainer), unbroken)


@pytest.fixture
def on_disk(tmp_path):
    """``on_disk(frames)`` records the tiny episodes and opens them as training clips."""

    def open_clips(frames: str) -> OfflineTrajectories:
        folder = tmp_path / "data"
        if not folder.exists():
            episodes = record()
            with EpisodeWriter(folder, target_episodes=len(episodes), meta={}, frames=frames) as writer:
                for episode in episodes:
                    writer.append(episode)
        return OfflineTrajectories(folder, num_frames=2, frame_skip=2, batch_size=16)

    return open_clips


@pytest.mark.parametrize("frames", ["raw", "png"])
def test_a_data_file_cut_short_stops_the_run_with_a_checkpoint_of_that_step(tmp_path, on_disk, unbroken, frames):
    """Without a look before each batch, the next page touched would be SIGBUS. Restored, the run ends as it should."""
    trainer = make_trainer(tmp_path / "run", data=on_disk(frames))
    (file,) = (tmp_path / "data").glob("pixels.memmap" if frames == "raw" else "pixels.blob")
    whole = file.read_bytes()
    at_step(trainer, 13, lambda: os.truncate(file, 1000))
    with pytest.raises(ReadError, match=f"{file.name} has shrunk from {len(whole)} to 1000 bytes: restore it"):
        trainer.train()
    with pytest.raises(ValueError, match="damaged"):
        on_disk(frames)
    file.write_bytes(whole)
    again = make_trainer(tmp_path / "run", data=on_disk(frames))
    assert again.resume() and again.step == 13
    again.train()
    assert same(weights(again), unbroken)


def test_a_damaged_image_stops_the_run_with_a_checkpoint_of_that_step(tmp_path, on_disk, unbroken):
    """The prefetching thread meets it; its error arrives, and the batches before it were trained on."""
    clips = on_disk("png")
    trainer = make_trainer(tmp_path / "run", data=clips)
    file = tmp_path / "data" / "pixels.blob"
    whole = file.read_bytes()
    at_step(trainer, 13, lambda: file.write_bytes(bytes(len(whole))))
    with pytest.raises(ReadError, match="the clips cannot be read: .*image"):
        trainer.train()
    file.write_bytes(whole)
    again = make_trainer(tmp_path / "run", data=on_disk("png"))
    assert again.resume() and again.step == 13
    again.train()
    assert same(weights(again), unbroken)


def test_a_vanished_data_file_lets_this_process_finish_and_the_next_one_say_so(tmp_path, on_disk, unbroken, warnings):
    """The mapping keeps the bytes."""
    trainer = make_trainer(tmp_path / "run", data=on_disk("raw"))
    at_step(trainer, 13, (tmp_path / "data" / "pixels.memmap").unlink)
    trainer.train()
    assert same(weights(trainer), unbroken)
    assert len(warnings) == 1 and "pixels.memmap has vanished" in warnings[0]
    with pytest.raises(ValueError, match="pixels.memmap is damaged"):
        on_disk("raw")


def test_after_a_nan_the_last_checkpoint_continues_as_if_nothing_had_happened(tmp_path, unbroken):
    trainer = make_trainer(tmp_path)
    at_step(trainer, 12, lambda: next(trainer.loss_module.encoder_params.parameters()).data.fill_(math.nan))
    with pytest.raises(FloatingPointError, match="step 13: not finite: .*; the last good checkpoint is "):
        trainer.train()
    again = make_trainer(tmp_path)
    assert again.resume() and again.step == 9
    again.train()
    assert same(weights(again), unbroken)


def test_a_logger_that_fails_in_the_middle_is_given_up_with_one_warning(tmp_path, unbroken, warnings):
    """Its disk is full. The run ends as it would have, and its checkpoints know nothing of the logger."""
    logger = get_logger("csv", logger_name=str(tmp_path / "log"), experiment_name="run")
    trainer = make_trainer(tmp_path / "run", logger=logger, log_interval=1)

    def fill_disk() -> None:
        trainer.logger.flush()
        for name, file in logger.experiment.files.items():
            file.close()
            logger.experiment.files[name] = open("/dev/full", "w")

    at_step(trainer, 5, fill_disk)
    trainer.train()
    assert same(weights(trainer), unbroken)
    assert len(warnings) == 1 and "CSVLogger is lost (OSError: [Errno 28]" in warnings[0]
    assert steps(tmp_path / "run") == [*range(1, 28)]
    assert "logger" not in Checkpoint.manifest(trainer.checkpoint_rotation.latest())["components"]
    assert make_trainer(tmp_path / "run").resume(), "without a logger, too"
    for file in logger.experiment.files.values():
        with suppress(OSError):
            file.close()


class Recorder:
    """A logger that takes a lock for every call, which whoever holds it hangs."""

    def __init__(self) -> None:
        self.free, self.seen = threading.Lock(), []

    def log_scalar(self, name, value, step=None) -> str:
        with self.free:
            self.seen.append((name, value, step))
        return "seen"


def test_a_logger_that_hangs_holds_nothing_up_and_is_told_once(unbroken, warnings):
    """Neither the training, with more calls than may wait, nor its end."""
    backend = Recorder()
    logger = TolerantLogger(backend, timeout=0.5, max_calls=4)
    trainer = make_trainer(logger=logger, log_interval=1)
    at_step(trainer, 5, lambda: logger.flush() or backend.free.acquire())
    began = time.monotonic()
    trainer.train()
    logger.flush()
    assert time.monotonic() - began < 30 and logger.lost
    assert same(weights(trainer), unbroken)
    assert warnings == ["Recorder is lost (no answer within 0.5 s): the run goes on without it."]
    backend.free.release()
    seen = len(backend.seen)
    logger.log_scalar("late", 1.0)
    assert len(backend.seen) <= seen + 1  # the call that hung was made, no other


@pytest.mark.parametrize("way", ["flush", "full"])
def test_a_hang_is_noticed_where_it_is_waited_for(warnings, way):
    backend = Recorder()
    logger = TolerantLogger(backend, timeout=0.2, max_calls=2)
    with backend.free:
        for step in range(2 if way == "flush" else 6):
            logger.log_scalar("loss", 0.0, step)
        if way == "flush":
            logger.flush()
        assert logger.lost and len(warnings) == 1


def test_a_logger_gets_every_call_in_order_with_the_numbers_of_its_time():
    """A tensor may be overwritten meanwhile; a function may call the logger itself, and gets what that returns."""
    backend, value = Recorder(), torch.zeros(1)
    logger, answers = TolerantLogger(backend), []
    with backend.free:
        for step in range(20):
            logger.log_scalar("loss", value.fill_(step), step)
        logger.attempt(lambda log: answers.append(log.log_scalar("last", 0.0)), logger)
    logger.flush()
    assert [(float(number), step) for _, number, step in backend.seen] == [*((s, s) for s in range(20)), (0.0, None)]
    assert answers == ["seen"] and not logger.lost


WANDB = """
import importlib.util, os, signal, sys
from pathlib import Path
from tiny import make_trainer, weights
import torch
from torchrl.record.loggers import get_logger
from torchrl_ficreg.trainers import TolerantLogger

here, number = Path.cwd(), signal.Signals[sys.argv[1]]
logger = get_logger("wandb", logger_name=str(here), experiment_name="run", wandb_kwargs={"mode": "offline"})
tolerant = TolerantLogger(logger, timeout=2)
trainer = make_trainer(logger=tolerant, log_interval=1)
tasks = Path(f"/proc/{os.getpid()}/task").glob("*/children")
children = [int(pid) for file in tasks for pid in file.read_text().split()]
service = [pid for pid in children if b"wandb" in Path(f"/proc/{pid}/cmdline").read_bytes()]
assert service
trainer.register_op("post_steps", lambda: trainer.step == 5 and os.kill(service[0], number))
(here / "service").write_text(str(service[0]))
trainer.train()
for name in ("sklearn", "torchvision", "transformers"):  # wandb would report them to its service
    if importlib.util.find_spec(name):
        importlib.import_module(name)
tolerant.shutdown()  # waits for the service
assert trainer.logger.lost
torch.save(weights(trainer), here / "weights.pt")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks for the service below /proc")
@pytest.mark.parametrize("number", ["SIGKILL", "SIGSTOP"])
def test_a_run_outlives_the_service_of_wandb(tmp_path, unbroken, number):
    """Killed or stopped in the middle, in a process of its own, where it can disturb nobody else; the process exits."""
    pytest.importorskip("wandb")
    paths = os.pathsep.join([os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": paths, "WANDB_MODE": "offline", "WANDB_X_SERVICE_WAIT": "120"}
    try:
        with open(tmp_path / "said", "w") as said:  # not a pipe, which the service would hold open
            line = [sys.executable, "-c", WANDB, number]
            done = subprocess.run(line, cwd=tmp_path, env=env, stdout=said, stderr=subprocess.STDOUT, timeout=120)
    finally:
        with suppress(OSError, ValueError):
            os.kill(int((tmp_path / "service").read_text()), signal.SIGKILL)
    said = (tmp_path / "said").read_text()
    assert done.returncode == 0, said
    assert said.count("WandbLogger is lost") == 1
    assert same(torch.load(tmp_path / "weights.pt"), unbroken)


@pytest.mark.parametrize(("error", "full"), [(OSError(28, "No space left on device"), True), (ConnectionError("lost"), False)])
def test_only_a_full_disk_is_told_as_one(tmp_path, monkeypatch, error, full):
    """Whatever else keeps a checkpoint from being written is told in its own words."""
    trainer = make_trainer(tmp_path)
    monkeypatch.setattr(Trainer, "_save_trainer", lambda self: (_ for _ in ()).throw(error))
    with pytest.raises(OSError, match="step 9 cannot be written .*the same command continues") as caught:
        trainer.train()
    assert ("make room" in str(caught.value)) == full


def test_sigterm_stops_after_the_step_in_progress_and_the_repeated_command_changes_no_bit(tmp_path, unbroken):
    """Sent in the middle of steps 5 and 14, which end no epoch; afterwards the signal means what it meant before."""
    handler = signal.getsignal(signal.SIGTERM)
    for stop_at in (5, 14):
        trainer = make_trainer(tmp_path)
        trainer.resume()
        send = lambda batch, t=trainer, at=stop_at: os.kill(os.getpid(), signal.SIGTERM) if t.step == at else None  # noqa: E731
        trainer.register_op("post_optim_log", send)
        with pytest.raises(Preempted, match="stopped by SIGTERM: the same command continues") as caught:
            with stop_on_signal(trainer):
                trainer.train()
        assert caught.value.code == PREEMPTED == 85
        assert trainer.step == stop_at
        assert signal.getsignal(signal.SIGTERM) is handler
    again = make_trainer(tmp_path)
    assert again.resume() and again.step == 14
    with stop_on_signal(again):
        again.train()
    assert same(weights(again), unbroken)
    assert steps(tmp_path) == [4, 8, 12, 16, 20, 24, 27]


@pytest.fixture
def foreground():
    """SIGINT as in a foreground job: one that a shell runs in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_writes_a_checkpoint_after_the_step_in_progress(tmp_path, unbroken, foreground):
    """Its exit code is that of an interrupted command; the repeated one changes no bit."""
    trainer = make_trainer(tmp_path)
    send = lambda batch: os.kill(os.getpid(), signal.SIGINT) if trainer.step == 5 else None  # noqa: E731
    trainer.register_op("post_optim_log", send)
    with pytest.raises(Preempted, match="stopped by SIGINT: the same command continues") as caught:
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    assert caught.value.code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    again = make_trainer(tmp_path)
    assert again.resume() and again.step == 5
    again.train()
    assert same(weights(again), unbroken)


def test_a_second_ctrl_c_stops_at_once(tmp_path, foreground):
    """In the middle of step 5, so that no checkpoint is written. SIGTERM may come as often as it likes."""
    trainer = make_trainer(tmp_path)

    def send(batch) -> None:
        if trainer.step == 5:
            for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGINT, signal.SIGINT):
                os.kill(os.getpid(), number)

    trainer.register_op("post_optim_log", send)
    with pytest.raises(KeyboardInterrupt):
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not find_or_none(tmp_path)


def test_a_background_job_goes_on_ignoring_ctrl_c(foreground):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with stop_on_signal(make_trainer(), signal.SIGTERM, signal.SIGINT):
        os.kill(os.getpid(), signal.SIGINT)


def find_or_none(run_dir):
    return next((run_dir / "checkpoints").glob("checkpoint-*"), None)


def evaluating(run_dir, evaluate) -> tuple:
    """A run of 27 steps that evaluates after every nine of them; ``evaluate(trainer)`` gets the trainer."""
    trainer = make_trainer(run_dir)
    hook = SuccessRate(lambda: evaluate(trainer), 9, trainer.metrics_table)
    hook.register(trainer)
    return trainer, hook


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 85), (signal.SIGINT, 130)])
def test_a_signal_ends_an_evaluation_at_once_and_the_epoch_is_kept(tmp_path, unbroken, foreground, number, code):
    """The evaluation of step 18 would never end. The run stops there with a checkpoint, and ends as it should."""
    finally_ran = []

    def evaluate(trainer) -> dict[str, float]:
        torch.rand(3)
        try:
            if trainer.step == 18:
                os.kill(os.getpid(), number)
                time.sleep(600)
        finally:
            finally_ran.append(trainer.step)
        return {"success_rate": 0.5}

    trainer, hook = evaluating(tmp_path, evaluate)
    began = time.monotonic()
    with pytest.raises(Preempted) as caught:
        with stop_on_signal(trainer, signal.SIGTERM, signal.SIGINT):
            trainer.train()
    assert time.monotonic() - began < 60
    assert caught.value.code == code
    assert finally_ran == [9, 18]
    assert trainer.loss_module.training
    assert hook.metadata(trainer) == {"success_rate": -1.0}
    rates = [Checkpoint.manifest(p)["metadata"]["success_rate"] for p in trainer.checkpoint_rotation.checkpoints()]
    assert rates == [0.5, -1.0]
    again, _ = evaluating(tmp_path, lambda trainer: {"success_rate": 0.25})
    assert again.resume() and again.step == 18
    again.train()
    assert same(weights(again), unbroken)


def test_an_evaluation_does_not_begin_when_a_signal_came_in_its_step(tmp_path):
    """Time is short; a stop that a hook of the user asked for is no hurry."""
    asked = []
    for name, stop in (
        ("signal", lambda trainer: os.kill(os.getpid(), signal.SIGTERM)),
        ("hook", lambda trainer: trainer.request_stop("early")),
    ):
        trainer, _ = evaluating(tmp_path / name, lambda trainer, name=name: asked.append(name) or {"success_rate": 1.0})
        at_step(trainer, 9, lambda trainer=trainer, stop=stop: stop(trainer))
        with suppress(Preempted), stop_on_signal(trainer):
            trainer.train()
        assert trainer.step == 9
    assert asked == ["hook"]


def test_a_signal_in_an_evaluation_means_what_it_meant_before_where_nobody_stops_the_trainer(tmp_path, foreground):
    """Ctrl-C in a notebook, say: KeyboardInterrupt, with the networks back in train mode."""

    def evaluate(trainer) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(600)

    trainer, _ = evaluating(tmp_path, evaluate)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert trainer.step == 9 and trainer.loss_module.training


def test_preempted_at_any_moment_a_process_exits_with_85_and_what_it_learned_is_kept(tmp_path):
    """Five lives, ended by the clock. The last checkpoint has the weights of a run that took so many steps at once."""
    context, chance, reached = multiprocessing.get_context("forkserver"), random.Random(0), 0
    context.set_forkserver_preload(["torchrl_ficreg.trainers"])
    for _ in range(5):
        process = context.Process(target=run_until_told, args=(tmp_path / "run",))
        process.start()
        while process.is_alive() and not (tmp_path / f"listens{reached}").exists():
            time.sleep(0.001)
        process.join(chance.uniform(0, 0.1))
        process.terminate()
        process.join(60)
        assert process.exitcode == 85
        before, reached = reached, Checkpoint.manifest(find_checkpoint(tmp_path / "run"))["metadata"]["optim_steps"]
        assert reached > before
    last = make_trainer(tmp_path / "run", validate=False, epochs=60)
    assert last.resume() and last.step == reached
    whole = make_trainer(validate=False, epochs=60)
    at_step(whole, reached, whole.request_stop)
    whole.train()
    assert same(weights(last), weights(whole))


def test_a_run_may_begin_from_the_checkpoint_of_another(tmp_path, unbroken):
    """It then has checkpoints of its own, and those are what continues."""
    make_trainer(tmp_path / "first").train()
    earlier, _ = sorted((tmp_path / "first" / "checkpoints").iterdir())
    second = make_trainer(tmp_path / "second")
    assert second.resume(earlier) and second.step == 18
    second.train()
    assert same(weights(second), unbroken)
    again = make_trainer(tmp_path / "second")
    assert again.resume(earlier) and again.step == 27
