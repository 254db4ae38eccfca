"""Claims about failures during a run: it stops or continues as documented, and the last checkpoint is intact.

Every fault is a real one: the system refuses to let a file grow, files are cut or removed.
"""

from __future__ import annotations

import resource
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from tiny import at_step, half_written, logged_steps, make_trainer, record, same, weights
from torchrl.trainers import Trainer

from torchrl_ficreg.data import EpisodeWriter, OfflineTrajectories
from torchrl_ficreg.trainers import load_world_model, ReadError


@contextmanager
def no_file_may_exceed(size: int):
    """What a full disk does to a growing file: a part is written, the rest is an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [2_000, 20_000], ids=["under the weights", "under the archive"])
def test_a_disk_that_fills_up_while_a_checkpoint_is_written_stops_the_run(tmp_path, continue_run, size):
    """The checkpoint before is whole, nothing half-written stays, and the same command ends with the same weights."""
    trainer, limits = make_trainer(tmp_path, log_interval=100), resource.getrlimit(resource.RLIMIT_FSIZE)
    at_step(trainer, 17, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1])))
    with no_file_may_exceed(limits[0]), pytest.raises(OSError, match="step 18 cannot be written .*make room"):
        trainer.train()
    assert not half_written(tmp_path)
    load_world_model(tmp_path)
    continue_run(tmp_path, 9, log_interval=100)


def test_a_disk_that_is_nearly_full_is_noticed_before_anything_is_written(tmp_path, monkeypatch):
    """A memory map that outgrows its disk is SIGBUS, so room is asked for first."""
    trainer = make_trainer(tmp_path, epochs=1)
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    at_step(trainer, 8, lambda: monkeypatch.setattr(shutil, "disk_usage", lambda place: full))
    with pytest.raises(OSError, match="no room for a checkpoint: .* needs .* MB, .* free: make room; the same command"):
        trainer.train()
    assert not list(tmp_path.glob("checkpoints/*"))


def test_room_is_asked_for_only_when_a_checkpoint_is_due(tmp_path, monkeypatch):
    """A disk that is full between two checkpoints stops nothing; one look for each of the three that are written."""
    looks, disk_usage = [], shutil.disk_usage
    trainer = make_trainer(tmp_path)

    def look(place):
        looks.append(trainer.step)
        return disk_usage(place) if trainer.step % 9 == 0 else disk_usage(place)._replace(free=0)

    monkeypatch.setattr(shutil, "disk_usage", look)
    trainer.train()
    assert looks == [9, 18, 27]


@pytest.mark.parametrize(("error", "full"), [(OSError(28, "No space left on device"), True), (ConnectionError("lost"), False)])
def test_only_a_full_disk_is_told_as_one(tmp_path, monkeypatch, error, full):
    """Whatever else keeps a checkpoint from being written is told in its own words."""
    trainer = make_trainer(tmp_path)
    monkeypatch.setattr(Trainer, "_save_trainer", lambda self: (_ for _ in ()).throw(error))
    with pytest.raises(OSError, match="step 9 cannot be written .*the same command continues") as caught:
        trainer.train()
    assert ("make room" in str(caught.value)) == full


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
    assert logged_steps(tmp_path) == [*range(1, 28)]
    assert same(weights(trainer), unbroken)


def on_disk(folder: Path, frames: str) -> OfflineTrajectories:
    """The tiny episodes, recorded and opened as training clips."""
    if not folder.exists():
        episodes = record()
        with EpisodeWriter(folder, target_episodes=len(episodes), meta={}, frames=frames) as writer:
            for episode in episodes:
                writer.append(episode)
    return OfflineTrajectories(folder, num_frames=2, frame_skip=2, batch_size=16)


@pytest.mark.parametrize(
    ("frames", "file", "damage", "message"),
    [
        ("raw", "pixels.memmap", lambda whole: whole[:1000], "pixels.memmap has shrunk from [0-9]+ to 1000 bytes: restore it"),
        ("png", "pixels.blob", lambda whole: whole[:1000], "pixels.blob has shrunk from [0-9]+ to 1000 bytes: restore it"),
        ("png", "pixels.blob", lambda whole: bytes(len(whole)), "the clips cannot be read: .*image"),
    ],
    ids=["cut", "cut images", "damaged images"],
)
def test_damaged_data_stop_the_run_with_a_checkpoint_of_that_step(tmp_path, continue_run, frames, file, damage, message):
    """Restored, the run ends as it should.

    Without a look before each batch, the next page of a file cut short would be SIGBUS. The prefetching thread meets a
    damaged image; its error arrives, and the batches before it were trained on.
    """
    trainer = make_trainer(tmp_path / "run", data=on_disk(tmp_path / "data", frames))
    file = tmp_path / "data" / file
    whole = file.read_bytes()
    with open(file, "r+b") as opened:

        def harm() -> None:
            opened.write(damage(whole))
            opened.truncate()

        at_step(trainer, 13, harm)
        with pytest.raises(ReadError, match=message):
            trainer.train()
    if len(damage(whole)) < len(whole):
        with pytest.raises(ValueError, match="damaged"):
            on_disk(tmp_path / "data", frames)
    file.write_bytes(whole)
    continue_run(tmp_path / "run", 13, data=on_disk(tmp_path / "data", frames))


def test_a_vanished_data_file_lets_this_process_finish_and_the_next_one_say_so(tmp_path, unbroken, warnings):
    """The mapping keeps the bytes."""
    trainer = make_trainer(tmp_path / "run", data=on_disk(tmp_path / "data", "raw"))
    at_step(trainer, 13, (tmp_path / "data" / "pixels.memmap").unlink)
    trainer.train()
    assert same(weights(trainer), unbroken)
    assert len(warnings) == 1 and "pixels.memmap has vanished" in warnings[0]
    with pytest.raises(ValueError, match="pixels.memmap is damaged"):
        on_disk(tmp_path / "data", "raw")
