"""Validation disturbs nothing, and TorchRL's own hooks and loggers act on the trainer as on any other."""

from __future__ import annotations

import csv
from collections import defaultdict

import pytest
import torch
from tiny import make_data, make_trainer, same, weights
from torchrl.record.loggers import get_logger
from torchrl.trainers.trainers import CountFramesLog, EarlyStopping, LogScalar, LogTiming, LRSchedulerHook

FRAMES = 16 * 2  # of one step: clips times frames of a clip


def table(run_dir):
    with open(run_dir / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_a_run_with_validation_trains_as_one_without():
    ends = []
    for validate in (True, False):
        trainer = make_trainer(validate=validate)
        trainer.train()
        ends.append({**weights(trainer), "random state": torch.get_rng_state()})
    assert same(*ends)


def test_validation_leaves_weights_statistics_mode_and_random_state_alone():
    """Called once more by hand: nothing at all has changed afterwards, and the loss is back in training mode."""
    trainer = make_trainer()
    trainer.train()
    (validation,) = [hook for hook, _ in trainer._post_steps_log_ops]
    before, random_state = weights(trainer), torch.get_rng_state()
    first = validation(make_data().sample())
    second = validation(make_data().sample())
    assert first == second
    assert same(weights(trainer), before)
    assert torch.equal(torch.get_rng_state(), random_state)
    assert trainer.loss_module.training and trainer.loss_module.encoder.training


def test_validation_is_the_mean_of_the_terms_in_eval_mode(tmp_path):
    """Recomputed by hand: no dropout, running statistics instead of the batch's, the first four held-out batches."""
    trainer = make_trainer(tmp_path, epochs=1, validation_batches=2)
    trainer.train()
    loss, data = trainer.loss_module.eval(), make_data("validation", drop_last=False)
    with torch.no_grad():
        terms = [loss(data.sample())["loss_pred"].item() for _ in range(2)]
    (row,) = [row for row in table(tmp_path) if row["split"] == "validation"]
    assert float(row["loss_pred"]) == pytest.approx(sum(terms) / 2, rel=1e-5)


def test_epochs_shorter_than_the_interval_lose_no_column(tmp_path):
    """The first row is then one of validation, which has fewer columns than those of training."""
    make_trainer(tmp_path, log_interval=20).train()
    rows = table(tmp_path)
    assert rows[0]["split"] == "validation"
    train = [row for row in rows if row["split"] == "train"]
    assert [row["step"] for row in train] == ["20", "27"]
    assert all(float(row[name]) > 0 for row in train for name in ("learning_rate", "grad_norm", "steps_per_second"))


def test_early_stopping_acts_on_a_logged_loss_and_leaves_a_checkpoint(tmp_path):
    """An improvement of 1e9 never comes: with a patience of ten steps the run ends ten steps after the first look."""
    trainer = make_trainer(tmp_path, log_interval=4)
    stop = EarlyStopping(monitor="loss_pred", mode="min", min_delta=1e9, patience=10 * FRAMES, wait_for=0)
    stop.register(trainer)
    trainer.train()
    assert trainer.step == 11
    assert "did not improve for 320 frames" in stop.stop_reason
    assert make_trainer_with_stop(tmp_path).step == 11


def make_trainer_with_stop(run_dir):
    trainer = make_trainer(run_dir, log_interval=4)
    EarlyStopping(monitor="loss_pred", mode="min").register(trainer)
    assert trainer.resume()
    return trainer


def test_early_stopping_waits_as_long_as_it_is_told():
    trainer = make_trainer(log_interval=4)
    EarlyStopping(monitor="loss_pred", mode="min", min_delta=1e9, patience=0, wait_for=20 * FRAMES).register(trainer)
    trainer.train()
    assert trainer.step == 21


def test_early_stopping_finds_its_metric_right_after_a_resume(tmp_path):
    """The step after a checkpoint writes no row, but the hook looks at the loss all the same."""
    make_trainer_with_stop_and_kill(tmp_path)
    trainer = make_trainer_with_stop(tmp_path)
    trainer.train()
    assert trainer.step == trainer.total_steps


def make_trainer_with_stop_and_kill(run_dir):
    trainer = make_trainer(run_dir, log_interval=4)
    EarlyStopping(monitor="loss_pred", mode="min").register(trainer)
    trainer.register_op("post_steps", lambda: trainer.step == 10 and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        trainer.train()


def test_torchrls_logging_hooks_write_to_the_logger(tmp_path):
    """LogScalar, LogTiming and CountFramesLog beside the trainer's own numbers, in a csv logger."""
    logger = get_logger("csv", logger_name=str(tmp_path), experiment_name="run")
    trainer = make_trainer(logger=logger, log_interval=1)
    LogScalar("action", "action_mean", include_std=True).register(trainer)
    CountFramesLog(frame_skip=1).register(trainer)
    LogTiming().register(trainer)
    trainer.train()
    folder = tmp_path / "run" / "scalars"
    scalars = {str(path.relative_to(folder))[:-4]: path.read_text().split() for path in folder.rglob("*.csv")}
    frames = [int(line.split(",")[0]) for line in scalars["loss_pred"]]
    assert frames == [FRAMES * step for step in range(1, 28)]
    data, expected = make_data(), []
    for _ in range(27):
        expected.append(data.sample()["action"].mean().item())
    assert [float(line.split(",")[1]) for line in scalars["action_mean"]] == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert float(scalars["n_frames"][-1].split(",")[1]) == 27 * FRAMES
    assert {"validation_loss_pred", "learning_rate", "action_mean_std"} <= set(scalars)
    assert any(name.startswith("time/") for name in scalars)


def test_a_second_schedule_acts_on_top():
    """LRSchedulerHook under another name: its factor 0.5 per step multiplies into the rate of the next update."""
    plain, halved = make_trainer(validate=False), make_trainer(validate=False)
    schedule = torch.optim.lr_scheduler.MultiplicativeLR(halved.optimizer, lambda step: 0.5)
    LRSchedulerHook(schedule, interval="optim").register(halved, name="halving")
    rates = defaultdict(list)
    for name, trainer in (("plain", plain), ("halved", halved)):
        trainer.optimizer.register_step_pre_hook(
            lambda opt, *_, seen=rates[name]: seen.append(opt.param_groups[0]["lr"])
        )
        trainer.train()
    assert rates["halved"][1] == pytest.approx(rates["plain"][1] / 2)


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
        assert [event.step for event in accumulator.Scalars("loss_pred")] == [FRAMES * step for step in range(1, 10)]
        assert len(accumulator.Scalars("validation_loss_pred")) == 1
    else:
        summary = dict(logger.experiment.summary)
        logger.experiment.finish()
        assert {"loss_pred", "loss_consistency", "learning_rate", "validation_loss_pred"} <= set(summary)
        assert list(tmp_path.rglob("run-*.wandb"))


def test_the_progress_bar_shows_the_terms_and_ends_at_the_last_step(capfd):
    make_trainer(progress_bar=True).train()
    err = capfd.readouterr().err
    assert "27/27" in err
    assert "consistency" in err and "sigreg" in err
