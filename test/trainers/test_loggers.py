"""Claims about loggers: a table survives damage, and a logger that fails or hangs costs one warning and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress

import pytest
import torch
from tiny import at_step, logged_steps, make_trainer, same, weights
from torchrl.checkpoint import Checkpoint
from torchrl.record.loggers import get_logger

from torchrl_ficreg.trainers import TolerantLogger
from torchrl_ficreg.trainers.loggers import CsvRows


def test_a_table_takes_new_columns_and_loses_nothing(tmp_path):
    table = CsvRows(tmp_path / "table.csv", first=("step", "split"))
    table.append({"step": 1, "split": "train", "a": 0.5})
    table.append({"step": 1, "split": "evaluation", "success_rate": 1.0})
    again = CsvRows(tmp_path / "table.csv")
    again.append({"step": 2, "split": "train", "a": 0.25})
    again.drop_after(1)
    assert (tmp_path / "table.csv").read_text().split() == [
        "step,split,a,success_rate",
        "1,train,0.5,",
        "1,evaluation,,1",
    ]


@pytest.mark.parametrize(
    "damage",
    [b"2,train," + b"9" * 200_000, b"2,train,\xff\x00", b"two,train,0.5", b"9" * 5000 + b",train,0.5", b'2,"train', b"2"],
)
def test_a_damaged_row_is_left_out_and_the_others_stay(tmp_path, damage):
    """A row of another step, a field of 200 kB, bytes that are no text, half a row."""
    table = CsvRows(tmp_path / "table.csv", first=("step", "split"))
    table.append({"step": 1, "split": "train", "a": 0.5})
    with open(table.path, "ab") as file:
        file.write(damage + b"\r\n")
    again = CsvRows(table.path)
    again.append({"step": 3, "split": "train", "a": 0.25, "b": 1.0})  # a new column rewrites the file
    again.drop_after(3)
    lines = table.path.read_text().split()
    assert lines[0] == "step,split,a,b" and lines[1] == "1,train,0.5," and lines[-1] == "3,train,0.25,1"


@pytest.mark.parametrize("content", [b"9" * 200_000 + b"\r\n1,train,0.5\r\n", None], ids=["header", "fifo"])
def test_a_table_that_is_none_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "table.csv"
    os.mkfifo(path) if content is None else path.write_bytes(content)
    with pytest.raises(ValueError, match="table.csv is (damaged|a FIFO)") as caught:
        CsvRows(path).drop_after(1)
    assert "\n" not in str(caught.value)


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
    assert logged_steps(tmp_path / "run") == [*range(1, 28)]
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


@pytest.mark.parametrize("backend", ["tensorboard", "wandb"])
def test_other_loggers_receive_the_numbers(tmp_path, monkeypatch, backend):
    pytest.importorskip(backend)
    monkeypatch.chdir(tmp_path)
    extra = {"wandb_kwargs": {"mode": "offline", "project": "test"}} if backend == "wandb" else {}
    logger = get_logger(backend, logger_name=str(tmp_path / "log"), experiment_name="run", **extra)
    make_trainer(logger=logger, epochs=1, log_interval=1).train()
    if backend == "tensorboard":
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        logger.experiment.flush()
        (events,) = (tmp_path / "log").rglob("events.out.*")
        accumulator = EventAccumulator(str(events))
        accumulator.Reload()
        assert [event.step for event in accumulator.Scalars("loss_pred")] == [16 * 2 * step for step in range(1, 10)]
        assert len(accumulator.Scalars("validation_loss_pred")) == 1
    else:
        summary = dict(logger.experiment.summary)
        logger.experiment.finish()
        assert {"loss_pred", "loss_consistency", "learning_rate", "validation_loss_pred"} <= set(summary)
        assert list(tmp_path.rglob("run-*.wandb"))


WANDB = """
import importlib.util, os, signal, sys
from pathlib import Path
from tiny import make_trainer, weights
import torch, wandb
from torchrl.record.loggers import get_logger
from torchrl_ficreg.trainers import TolerantLogger

def lose_the_service(number):
    logger = get_logger("wandb", logger_name=".", experiment_name="run", wandb_kwargs={"mode": "offline"})
    tolerant = TolerantLogger(logger, timeout=2)
    trainer = make_trainer(logger=tolerant, log_interval=1)
    tasks = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    children = [int(pid) for file in tasks for pid in file.read_text().split()]
    (service,) = [pid for pid in children if b"wandb" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    trainer.register_op("post_steps", lambda: trainer.step == 5 and os.kill(service, number))
    Path("service").write_text(str(service))
    trainer.train()
    for name in ("sklearn", "torchvision", "transformers"):  # wandb would report them to its service
        if importlib.util.find_spec(name):
            importlib.import_module(name)
    tolerant.shutdown()  # waits for the service
    assert trainer.logger.lost
    torch.save(weights(trainer), "weights.pt")

runs = []
for number in (signal.SIGKILL, signal.SIGSTOP):
    runs.append(os.fork())
    if not runs[-1]:
        os.mkdir(number.name)
        os.chdir(number.name)
        said = os.open("said", os.O_WRONLY | os.O_CREAT)  # not a pipe, which the service would hold open
        os.dup2(said, 1), os.dup2(said, 2)
        lose_the_service(number)
        break  # and ends as any process does
else:
    sys.exit(any([os.waitpid(run, 0)[1] for run in runs]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks for the service below /proc")
def test_a_run_outlives_the_service_of_wandb(tmp_path, unbroken):
    """Killed or stopped in the middle, in processes of their own, where it can disturb nobody else; they exit."""
    pytest.importorskip("wandb")
    paths = os.pathsep.join([os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": paths, "WANDB_MODE": "offline", "WANDB_X_SERVICE_WAIT": "120"}
    env.pop("WANDB_SERVICE", None)  # of another test in this process
    try:
        code = subprocess.run([sys.executable, "-c", WANDB], cwd=tmp_path, env=env, timeout=120).returncode
    finally:
        for file in tmp_path.glob("*/service"):
            with suppress(OSError, ValueError):
                os.kill(int(file.read_text()), signal.SIGKILL)
    for run in (tmp_path / "SIGKILL", tmp_path / "SIGSTOP"):
        said = (run / "said").read_text()
        assert code == 0 and said.count("WandbLogger is lost") == 1, said
        assert same(torch.load(run / "weights.pt"), unbroken)
