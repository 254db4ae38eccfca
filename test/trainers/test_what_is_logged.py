"""A row of metrics tells whether the run is healthy and what holds it up; looking changes nothing."""

from __future__ import annotations

import csv
import dataclasses
import os
import time

import pytest
import torch
from tiny import make_data, make_trainer, same, SIZES, weights
from torchrl.checkpoint import Checkpoint

from torchrl_ficreg import TemporalStraightness
from torchrl_ficreg.trainers import find_checkpoint, LatentAlarm, SuccessRate
from torchrl_ficreg.trainers.loggers import CsvRows


def rows(run_dir, split: str = "train") -> list[dict[str, str]]:
    with open(run_dir / "metrics.csv", newline="") as file:
        return [row for row in csv.DictReader(file) if row["split"] == split]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of three-frame clips with everything that can be logged, and its rows."""
    run_dir = tmp_path_factory.mktemp("logged")
    sizes = dataclasses.replace(SIZES, history=2)
    trainer = make_trainer(run_dir, data=make_data(num_frames=3), sizes=sizes, log_interval=1, validate=False)
    trainer.loss_module.diagnostics = True
    LatentAlarm(interval=4, table=trainer.metrics_table).register(trainer)
    trainer.train()
    return trainer, rows(run_dir)


def test_a_row_has_losses_gradients_latents_speed_and_memory(trained):
    """All finite in every row, from the first step on."""
    names = [f"loss_{term}" for term in ("pred", "sigreg", "idm", "consistency")]
    names += [f"grad_norm_{network}" for network in ("encoder", "predictor", "inverse_model")]
    names += ["judge_r2_real", "judge_r2_imagined", "floor_ratio", "effective_rank", "straightness"]
    names += ["steps_per_second", "clips_per_second", "loader_share", "memory_gib"]
    for row in trained[1]:
        assert all(abs(float(row[name])) < 1e9 for name in names), row


def test_the_norms_of_the_networks_make_up_the_norm_of_all(trained):
    """Squares add up, before clipping; the inverse model's is there although its weight in the sum is small."""
    for row in trained[1]:
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
    alarm = LatentAlarm(interval=1, precision="fp32")
    alarm._trainer = trainer
    latent = trainer.loss_module.peek(batch)  # [T, B, D]
    expected = TemporalStraightness()(latent.transpose(0, 1)).item()
    assert alarm(batch)["straightness"] == pytest.approx(expected, rel=1e-5)
    assert -1 <= expected <= 1
    alarm._trainer = make_trainer()
    alarm._trainer._optim_count = 1
    assert "straightness" not in alarm(make_data().sample())


def test_a_slow_loader_shows_in_its_share_of_a_step(tmp_path):
    """Each batch is held back for 50 ms. The share times the time of a step is the wait."""
    data = make_data()
    sample = data.sample

    def slow_sample():
        time.sleep(0.05)
        return sample()

    data.sample = slow_sample
    make_trainer(tmp_path, data=data, epochs=1, log_interval=3, validate=False).train()
    for row in rows(tmp_path):
        waited = float(row["loader_share"]) / float(row["steps_per_second"])
        assert 0.05 <= waited < 1 / float(row["steps_per_second"])
        assert float(row["clips_per_second"]) == pytest.approx(16 * float(row["steps_per_second"]), rel=1e-4)


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
    "damage", [b"2,train," + b"9" * 200_000, b"2,train,\xff\x00", b"two,train,0.5", b"9" * 5000 + b",train,0.5", b'2,"train', b"2"]
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


def test_what_is_kept_in_memory_does_not_grow_with_the_run():
    """Hooks find the latest numbers of each kind; the table has all."""
    trainer = make_trainer(epochs=15, log_interval=1, validate=False)
    trainer.train()
    assert trainer.step == 135
    assert 1 <= max(len(values) for values in trainer._log_dict.values()) <= 100


def with_success(run_dir, rates: dict[int, float], **settings):
    """A trainer of five epochs of nine steps that is told what success it had after each of them."""
    trainer = make_trainer(run_dir, epochs=5, **settings)

    def evaluate() -> dict[str, float]:
        torch.rand(3)  # as a planner would draw
        assert not trainer.loss_module.encoder.training
        return {"success_rate": rates[trainer.step]}

    hook = SuccessRate(evaluate, 9, trainer.metrics_table)
    hook.register(trainer)
    return trainer, hook


RATES = {9: 0.2, 18: 0.7, 27: 0.3, 36: 0.7, 45: 0.6}


def test_the_best_checkpoint_is_kept_beside_the_latest(tmp_path):
    """Step 9 was best at first; of two equal ones the later counts. A resumed run goes on from that knowledge."""
    broken, _ = with_success(tmp_path, {**RATES, 36: 0.5})
    broken.register_op("post_steps", lambda: broken.step == 40 and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        broken.train()
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
    assert [(int(row["step"]), float(row["success_rate"])) for row in rows(tmp_path, "evaluation")][-1] == (45, 0.6)


def test_a_run_with_evaluations_trains_as_one_without(tmp_path):
    with_evaluations, _ = with_success(tmp_path, RATES)
    with_evaluations.train()
    without = make_trainer(epochs=5)
    without.train()
    assert same(weights(with_evaluations), weights(without))


def test_a_success_that_was_not_measured_makes_no_best_checkpoint(tmp_path):
    """Neither without evaluation, nor after the weights were changed by somebody else."""
    make_trainer(tmp_path / "plain", epochs=1).train()
    trainer, hook = with_success(tmp_path / "changed", dict.fromkeys(RATES, 0.5))
    trainer.register_op("post_steps_log", lambda batch: hook.forget())
    trainer.train()
    for name in ("plain", "changed"):
        with pytest.raises(FileNotFoundError, match="no checkpoint with a measured success"):
            find_checkpoint(tmp_path / name, best=True)
