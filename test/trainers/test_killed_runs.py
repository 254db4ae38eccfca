"""A run may be killed at any instant: started again, it ends with the very weights of an unbroken one."""

from __future__ import annotations

import csv
import multiprocessing
import os
import random
import time
from pathlib import Path

import pytest
import torch
from tiny import make_data, make_trainer, run, same, weights

from torchrl_ficreg.trainers import load_world_model

TIMED = ("steps_per_second", "clips_per_second", "loader_share", "memory_gib")


def losses(run_dir: Path) -> list[dict[str, str]]:
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{key: value for key, value in row.items() if key not in TIMED} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Metrics and weights of a run that nobody disturbed, validation and prefetching included."""
    path = tmp_path_factory.mktemp("unbroken")
    run(path / "run", path / "weights.pt")
    return losses(path / "run"), torch.load(path / "weights.pt")


@pytest.fixture(scope="module")
def start():
    """``start(run_dir, weights_file)`` begins a run in a process of its own; imports are done once, before the fork."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchrl_ficreg.trainers"])

    def begin(*arguments: Path) -> multiprocessing.Process:
        process = context.Process(target=run, args=arguments)
        process.start()
        return process

    return begin


def finish(start, path: Path) -> None:
    process = start(path / "run", path / "weights.pt")
    process.join(120)
    assert process.exitcode == 0


def published(run_dir: Path) -> set[str]:
    return {path.name for path in (run_dir / "checkpoints").glob("checkpoint-*")}


def half_written(run_dir: Path) -> set[str]:
    folder = run_dir / "checkpoints"
    return {name for name in os.listdir(folder) if name.startswith(".")} if folder.is_dir() else set()


def resumed_at(path: Path) -> set[int]:
    """Steps, other than zero, at which a process of the run began."""
    return {int(line) for line in (path / "weights.starts").read_text().split()} - {0}


def test_kills_at_ten_random_moments_change_no_bit(start, unbroken, tmp_path):
    """Each at some moment of start, resumption, the epochs after it or a save; whatever is left loads at once."""
    chance, run_dir = random.Random(0), tmp_path / "run"
    for kill in range(10):
        process = start(run_dir, tmp_path / "weights.pt")
        begun_with = published(run_dir)
        while process.is_alive() and kill % 2 and not published(run_dir) - begun_with:
            time.sleep(0.001)
        process.join(chance.uniform(0, 0.15 if kill % 2 else 1.0))
        process.kill()
        process.join()
        if published(run_dir):
            load_world_model(run_dir)
    finish(start, tmp_path)
    metrics, final = unbroken
    assert len(resumed_at(tmp_path)) >= 2
    assert losses(run_dir) == metrics
    assert same(torch.load(tmp_path / "weights.pt"), final)


def test_kills_in_the_middle_of_writing_a_checkpoint_change_no_bit(start, unbroken, tmp_path):
    """Killed while the first checkpoint is being written, then twice while a later one is; the rest is swept."""
    run_dir, torn = tmp_path / "run", 0
    for attempt in range(20):
        process = start(run_dir, tmp_path / "weights.pt")
        begun_with = published(run_dir)
        while process.is_alive() and not (half_written(run_dir) and (attempt == 0 or published(run_dir) - begun_with)):
            time.sleep(0.0002)
        process.kill()
        process.join()
        torn += bool(half_written(run_dir))
        if torn == 3:
            break
    assert torn == 3, "the parent never caught the child in the act"
    finish(start, tmp_path)
    metrics, final = unbroken
    assert resumed_at(tmp_path)
    assert losses(run_dir) == metrics
    assert same(torch.load(tmp_path / "weights.pt"), final)
    assert not half_written(run_dir)
    load_world_model(run_dir)


def test_no_step_is_missing_or_twice_in_the_metrics(unbroken):
    steps = [(row["split"], int(row["step"])) for row in unbroken[0]]
    assert [step for split, step in steps if split == "train"] == [*range(4, 54, 4), 54]
    assert [step for split, step in steps if split == "validation"] == [*range(9, 55, 9)]


@pytest.mark.parametrize("torn", ["", "step,split\n", "step,split,loss_pred\n4,train,0.1\n9,tr"])
def test_a_table_torn_by_the_kill_is_mended(tmp_path, torn):
    """An empty file, a lone header or half a row left before the first checkpoint are written anew."""
    trainer = make_trainer(tmp_path / "run", epochs=1)
    (tmp_path / "run").mkdir(exist_ok=True)
    (tmp_path / "run" / "metrics.csv").write_text(torn)
    assert not trainer.resume()
    trainer.train()
    assert [row["step"] for row in losses(tmp_path / "run")] == ["4", "8", "9", "9"]


def test_resuming_restores_optimiser_schedule_random_state_and_position(tmp_path):
    """Interrupted by an exception between two checkpoints, the second life starts from the state of the first one."""
    whole = make_trainer()
    whole.train()
    broken = make_trainer(tmp_path, data=make_data())
    broken.register_op("post_steps", lambda: broken.step == 14 and (_ for _ in ()).throw(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        broken.train()
    again = make_trainer(tmp_path)
    torch.manual_seed(123)  # dropout must not depend on what the new process drew
    assert again.resume()
    assert again.step == 9
    moments = [state["step"].item() for state in again.optimizer.state.values()]
    assert moments == [9.0] * len(moments) and moments
    assert again.collector.replay_buffer.batches == 9
    again.train()
    assert same(weights(again), weights(whole))


def test_a_finished_run_does_not_train_again(tmp_path):
    first = make_trainer(tmp_path)
    first.train()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    second = make_trainer(tmp_path)
    assert second.resume()
    second.train()
    assert second.step == second.total_steps
    assert same(weights(first), weights(second))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_other_data_or_networks_cannot_continue_a_run(tmp_path):
    """A position among other clips, or weights of another method, are refused in words and nothing changes on disk."""
    make_trainer(tmp_path, epochs=1).train()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match="cannot be continued .*154 clips in batches of 16, here are 154 in batches of 8"):
        make_trainer(tmp_path, epochs=1, data=make_data(batch_size=8)).resume()
    with pytest.raises(ValueError, match="cannot be continued .*, here are [0-9]+ in batches of 16"):
        make_trainer(tmp_path, epochs=1, data=make_data(episodes=12)).resume()
    with pytest.raises(ValueError, match="cannot be continued"):
        make_trainer(tmp_path, epochs=1, method="lewm").resume()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
