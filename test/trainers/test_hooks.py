"""Claims about hooks: what is measured is right, measuring changes nothing, and TorchRL's own hooks work as well."""

from __future__ import annotations

import dataclasses
import time

import pytest
import torch
from tiny import make_data, make_trainer, same, SIZES, table, train_interrupted, watch_updates, weights
from torchrl.checkpoint import Checkpoint
from torchrl.record.loggers import get_logger
from torchrl.trainers.trainers import CountFramesLog, EarlyStopping, LogScalar, LogTiming, LRSchedulerHook

from torchrl_ficreg import TemporalStraightness
from torchrl_ficreg.trainers import CollapseMonitor, EvaluationHook, find_checkpoint, Validation

FRAMES = 16 * 2  # of one step: clips times frames of a clip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of three-frame clips with everything that can be logged, and its rows."""
    run_dir = tmp_path_factory.mktemp("logged")
    sizes = dataclasses.replace(SIZES, history=2)
    trainer = make_trainer(run_dir, data=make_data(num_frames=3), sizes=sizes, log_interval=1, validate=False)
    trainer.loss_module.diagnostics = True
    CollapseMonitor(interval=4, table=trainer.metrics_table).register(trainer)
    trainer.train()
    return trainer, table(run_dir, "train")


def test_a_row_has_losses_gradients_latents_speed_and_memory(trained):
    """All finite in every row, from the first step on.

    Before clipping, the squares of the networks' norms add up to that of all; the inverse model's is there although its
    weight in the sum is small.
    """
    names = [f"loss_{term}" for term in ("pred", "sigreg", "idm", "consistency")]
    names += [f"grad_norm_{network}" for network in ("encoder", "predictor", "inverse_model")]
    names += ["judge_r2_real", "judge_r2_imagined", "floor_ratio", "effective_rank", "straightness"]
    names += ["steps_per_second", "clips_per_second", "loader_share", "memory_gib"]
    for row in trained[1]:
        assert all(abs(float(row[name])) < 1e9 for name in names), row
        parts = [float(value) for name, value in row.items() if name.startswith("grad_norm_")]
        assert len(parts) == 3 and min(parts) > 0
        assert sum(part**2 for part in parts) ** 0.5 == pytest.approx(float(row["grad_norm"]), rel=1e-4)


def test_norms_of_networks_are_computed_for_rows_alone(tmp_path):
    trainer, seen = make_trainer(tmp_path, log_interval=4, validate=False), []
    trainer.register_op("post_optim_complete_log", lambda step, losses: seen.append("grad_norm_encoder" in losses.keys()))
    trainer.train()
    assert [step for step, has in enumerate(seen, 1) if has] == [4, 8, 12, 16, 20, 24, 27]


def test_straightness_is_that_of_the_latents_in_training_and_two_frames_have_none(trained):
    trainer, _ = trained
    batch = make_data(num_frames=3).sample()
    monitor = CollapseMonitor(interval=1, precision="fp32")
    monitor.register(trainer, "second")
    latent = trainer.loss_module.peek(batch)  # [T, B, D]
    expected = TemporalStraightness()(latent.transpose(0, 1)).item()
    assert monitor(batch)["straightness"] == pytest.approx(expected, rel=1e-5)
    assert -1 <= expected <= 1
    monitor.register(make_trainer())
    assert "straightness" not in monitor(make_data().sample())


def test_a_slow_loader_shows_in_its_share_of_a_step(tmp_path):
    """Each batch is held back for 50 ms. The share times the time of a step is the wait."""
    data = make_data()
    sample = data.sample

    def slow_sample():
        time.sleep(0.05)
        return sample()

    data.sample = slow_sample
    make_trainer(tmp_path, data=data, epochs=1, log_interval=3, validate=False).train()
    for row in table(tmp_path, "train"):
        waited = float(row["loader_share"]) / float(row["steps_per_second"])
        assert 0.05 <= waited < 1 / float(row["steps_per_second"])
        assert float(row["clips_per_second"]) == pytest.approx(16 * float(row["steps_per_second"]), rel=1e-4)


def test_validation_leaves_weights_statistics_mode_and_random_state_alone():
    """A run with it ends as one without. Called twice it returns the same numbers, and the loss is in training mode."""
    plain = make_trainer(validate=False)
    plain.train()
    expected = {**weights(plain), "random state": torch.get_rng_state()}
    trainer = make_trainer(validate=False)
    validation = Validation(make_data("validation", drop_last=False), 9, 4, "fp32", trainer.metrics_table)
    validation.register(trainer)
    trainer.train()
    assert same({**weights(trainer), "random state": torch.get_rng_state()}, expected)
    assert validation(make_data().sample()) == validation(make_data().sample())
    assert same({**weights(trainer), "random state": torch.get_rng_state()}, expected)
    assert trainer.loss_module.training and trainer.loss_module.encoder.training


def test_validation_is_the_mean_of_the_terms_in_eval_mode(tmp_path):
    """Recomputed by hand: no dropout, running statistics instead of the batch's, the first four held-out batches."""
    trainer = make_trainer(tmp_path, epochs=1, validation_batches=2)
    trainer.train()
    loss, data = trainer.loss_module.eval(), make_data("validation", drop_last=False)
    with torch.no_grad():
        terms = [loss(data.sample())["loss_pred"].item() for _ in range(2)]
    (row,) = table(tmp_path, "validation")
    assert float(row["loss_pred"]) == pytest.approx(sum(terms) / 2, rel=1e-5)


def with_success(run_dir, rates: dict[int, float], **settings):
    """A trainer of epochs of nine steps whose evaluation returns ``rates`` by step."""
    trainer = make_trainer(run_dir, **{"epochs": 5, **settings})

    def evaluate() -> dict[str, float]:
        torch.rand(3)  # as a planner would draw
        assert not trainer.loss_module.encoder.training
        return {"success_rate": rates[trainer.step]}

    hook = EvaluationHook(evaluate, 9, trainer.metrics_table)
    hook.register(trainer)
    return trainer, hook


RATES = {9: 0.2, 18: 0.7, 27: 0.3, 36: 0.7, 45: 0.6}


def test_the_best_checkpoint_is_kept_beside_the_latest(tmp_path):
    """Step 9 was best at first; of two equal ones the later counts. A resumed run goes on from that knowledge."""
    broken, _ = with_success(tmp_path, {**RATES, 36: 0.5})
    train_interrupted(broken, 40)
    again, _ = with_success(tmp_path, RATES)
    assert again.resume() and again.step == 36
    again.train()
    kept = {Checkpoint.manifest(path)["metadata"]["optim_steps"] for path in (tmp_path / "checkpoints").iterdir()}
    assert kept == {18, 36, 45}
    assert Checkpoint.manifest(find_checkpoint(tmp_path, best=True))["metadata"] | {"collected_frames": 0} == {
        "success_rate": 0.7,
        "optim_steps": 18,
        "collected_frames": 0,
    }
    assert Checkpoint.manifest(find_checkpoint(tmp_path))["metadata"]["optim_steps"] == 45
    assert [(int(row["step"]), float(row["success_rate"])) for row in table(tmp_path, "evaluation")][-1] == (45, 0.6)


def test_a_success_that_was_not_measured_makes_no_best_checkpoint(tmp_path):
    """Neither without evaluation, nor after something else changed the weights."""
    make_trainer(tmp_path / "plain", epochs=1).train()
    trainer, hook = with_success(tmp_path / "changed", RATES, epochs=1)
    trainer.register_op("post_steps_log", lambda batch: hook.forget())
    trainer.train()
    for name in ("plain", "changed"):
        with pytest.raises(FileNotFoundError, match="no checkpoint with a measured success"):
            find_checkpoint(tmp_path / name, best=True)


def stopping(run_dir, **settings):
    """A trainer with TorchRL's ``EarlyStopping``, which never stops it unless told."""
    trainer = make_trainer(run_dir, log_interval=4)
    stop = EarlyStopping(monitor="loss_pred", mode="min", **settings)
    stop.register(trainer)
    return trainer, stop


@pytest.mark.parametrize(("patience", "wait_for", "step"), [(10, 0, 11), (0, 20, 21)])
def test_early_stopping_acts_on_a_logged_loss_and_leaves_a_checkpoint(tmp_path, patience, wait_for, step):
    """An improvement of 1e9 never comes: the run ends after a patience of ten steps, or as late as it is told to."""
    trainer, stop = stopping(tmp_path, min_delta=1e9, patience=patience * FRAMES, wait_for=wait_for * FRAMES)
    trainer.train()
    assert trainer.step == step
    assert f"did not improve for {patience * FRAMES} frames" in stop.stop_reason or not patience
    again, _ = stopping(tmp_path)
    assert again.resume() and again.step == step


def test_early_stopping_finds_its_metric_right_after_a_resume(tmp_path):
    """The step after a checkpoint writes no row, but the hook looks at the loss all the same."""
    broken, _ = stopping(tmp_path)
    train_interrupted(broken, 10)
    again, _ = stopping(tmp_path)
    assert again.resume()
    again.train()
    assert again.step == again.total_steps


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
    rates = [watch_updates(each, lambda each=each: each.optimizer.param_groups[0]["lr"]) for each in (plain, halved)]
    plain.train(), halved.train()
    assert rates[1][1] == pytest.approx(rates[0][1] / 2)


def test_the_progress_bar_shows_the_terms_and_ends_at_the_last_step(capfd):
    make_trainer(progress_bar=True).train()
    err = capfd.readouterr().err
    assert "27/27" in err
    assert "consistency" in err and "sigreg" in err
