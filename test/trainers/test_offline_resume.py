"""Claims about resumption: killed at any time and started again, a run ends with the weights of an unbroken one."""

from __future__ import annotations

import multiprocessing
import random
import time
from pathlib import Path

import pytest
import torch
from tiny import damage, half_written, make_data, make_trainer, record, run, same, snapshot, table

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.trainers import load_world_model

TIMED = ("steps_per_second", "clips_per_second", "loader_share", "memory_gib")


def losses(run_dir: Path) -> list[dict[str, str]]:
    return [{key: value for key, value in row.items() if key not in TIMED} for row in table(run_dir)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Metrics and weights of a run of six epochs that was not interrupted, validation and prefetching included."""
    path = tmp_path_factory.mktemp("whole")
    run(path / "run", path / "weights.pt")
    return losses(path / "run"), torch.load(path / "weights.pt")


@pytest.fixture(scope="module")
def start():
    """``start(run_dir, weights_file)`` begins a run in a process of its own; imports are done once, before the fork."""

    def begin(*arguments: Path) -> multiprocessing.Process:
        process = multiprocessing.get_context("forkserver").Process(target=run, args=arguments)
        process.start()
        return process

    return begin


def finish(start, path: Path, whole) -> None:
    """The last start ends with the metrics and weights of the whole run."""
    process = start(path / "run", path / "weights.pt")
    process.join(120)
    assert process.exitcode == 0
    assert losses(path / "run") == whole[0]
    assert same(torch.load(path / "weights.pt"), whole[1])


def published(run_dir: Path) -> set[str]:
    return {path.name for path in (run_dir / "checkpoints").glob("checkpoint-*")}


def resumed_at(path: Path) -> set[int]:
    """Steps, other than zero, at which a process of the run began."""
    return {int(line) for line in (path / "weights.starts").read_text().split()} - {0}


def test_kills_at_random_times_change_no_bit(start, whole, tmp_path):
    """Each at some moment of start, resumption, the epochs after it or a save; whatever is left loads at once."""
    chance, run_dir = random.Random(0), tmp_path / "run"
    for kill in range(6):
        process = start(run_dir, tmp_path / "weights.pt")
        begun_with = published(run_dir)
        while process.is_alive() and kill % 2 and not published(run_dir) - begun_with:
            time.sleep(0.001)
        process.join(chance.uniform(0, 0.15 if kill % 2 else 1.0))
        process.kill()
        process.join()
        if published(run_dir):
            load_world_model(run_dir)
    finish(start, tmp_path, whole)
    assert len(resumed_at(tmp_path)) >= 2


def test_kills_while_a_checkpoint_is_written_change_no_bit(start, whole, tmp_path):
    """Killed while the first checkpoint is being written, then twice while a later one is; what is left is removed."""
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
    finish(start, tmp_path, whole)
    assert resumed_at(tmp_path)
    assert not half_written(run_dir)
    load_world_model(run_dir)


def test_no_step_is_missing_or_twice_in_the_metrics(whole):
    steps = [(row["split"], int(row["step"])) for row in whole[0]]
    assert [step for split, step in steps if split == "train"] == [*range(4, 54, 4), 54]
    assert [step for split, step in steps if split == "validation"] == [*range(9, 55, 9)]


@pytest.mark.parametrize("torn", ["", "step,split\n", "step,split,loss_pred\n4,train,0.1\n9,tr"])
def test_a_table_torn_by_a_kill_is_repaired(tmp_path, torn):
    """An empty file, a lone header or half a row left before the first checkpoint are written anew."""
    trainer = make_trainer(tmp_path / "run", epochs=1)
    (tmp_path / "run").mkdir(exist_ok=True)
    (tmp_path / "run" / "metrics.csv").write_text(torn)
    assert not trainer.resume()
    trainer.train()
    assert [row["step"] for row in losses(tmp_path / "run")] == ["4", "8", "9", "9"]


def test_other_data_or_networks_cannot_continue_a_run(run_dir):
    """Another number of clips, one other value of a state, or another method: refused in one line, no file changes."""
    before, episodes = snapshot(run_dir), record()
    episodes[0]["state"][0] += 1
    other = OfflineTrajectories.from_episodes(episodes, split="train", num_frames=2, frame_skip=2, batch_size=16)
    for settings, reason in (
        ({"data": make_data(batch_size=8)}, "154 clips in batches of 16, here are 154 in batches of 8"),
        ({"data": make_data(episodes=12)}, ", here are [0-9]+ in batches of 16"),
        ({"data": other}, "the checkpoint belongs to other data"),
        ({"method": "lewm"}, ""),
    ):
        with pytest.raises(ValueError, match=f"cannot be continued .*{reason}") as caught:
            make_trainer(run_dir, **settings).resume()
        assert "\n" not in str(caught.value) or "method" in settings
    assert snapshot(run_dir) == before
    assert make_trainer(run_dir).resume()


def test_training_in_a_used_folder_without_resume_is_refused(run_dir, continue_run):
    """It would write every row twice and replace the checkpoints. Resumed, the finished run has nothing left to do."""
    before = snapshot(run_dir)
    trainer = make_trainer(run_dir)
    with pytest.raises(ValueError, match=r"holds checkpoints of a run: call resume\(\) .* another run_dir"):
        trainer.train()
    assert trainer.step == 0 and snapshot(run_dir) == before
    continue_run(run_dir, 27)
    assert snapshot(run_dir) == before


def test_a_run_may_begin_from_the_checkpoint_of_another(run_dir, tmp_path, continue_run):
    """It then writes checkpoints of its own, from which it is resumed."""
    earlier, _ = sorted((run_dir / "checkpoints").iterdir())
    for step in (18, 27):
        continue_run(tmp_path / "second", step, earlier)


@pytest.mark.parametrize("how", ["truncated", "flipped"])
def test_damaged_checkpoints_that_are_all_there_is_are_named_and_not_touched(run_dir, how):
    first, last = sorted((run_dir / "checkpoints").iterdir())
    damage(last, how), damage(first, "flipped")
    before = snapshot(run_dir)
    with pytest.raises(ValueError, match=f"{first.name} is damaged and there is no other checkpoint: move it away"):
        make_trainer(run_dir).resume()
    assert snapshot(run_dir) == before


def test_what_killed_processes_left_half_written_is_harmless_and_removed(run_dir, tmp_path):
    """A link is removed, and not what it points to."""
    folder = run_dir / "checkpoints"
    (folder / ".checkpoint-000000000999.torchrl.stage-ab" / "components").mkdir(parents=True)
    (folder / ".checkpoint-000000000999.torchrl.archive-cd").write_bytes(b"PK")
    (thesis := tmp_path / "thesis").mkdir()
    (thesis / "text").write_text("long")
    (folder / ".checkpoint-1.stage-1").symlink_to(thesis)
    load_world_model(run_dir)
    trainer = make_trainer(run_dir)
    assert trainer.resume() and trainer.step == 27
    assert not half_written(run_dir)
    assert (thesis / "text").read_text() == "long"
