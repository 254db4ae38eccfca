"""Datasets that were damaged or moved are refused by name; file systems that lack locks or fsync are written all the same."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os

import numpy as np
import pytest

from torchrl_ficreg._utils import lock_file
from torchrl_ficreg.data import EpisodeStore, EpisodeWriter, OfflineTrajectories
from torchrl_ficreg.data.layout import checksums, IndexEntry, sync_directory

DELETED = object()


def change_header(path, **fields):
    content = json.loads((path / "meta.json").read_text())
    for name, value in fields.items():
        if value is DELETED:
            del content[name]
        elif name in content["shapes"]:
            content["shapes"][name] = value
        else:
            content[name] = value
    (path / "meta.json").write_text(json.dumps(content))


def refused(path, meta, message, target=2):
    """Reading and writing refuse the dataset, in one short line."""
    for way in (EpisodeStore.open, lambda path: EpisodeWriter(path, target_episodes=target, meta=meta)):
        with pytest.raises(ValueError, match=message) as error:
            way(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 350


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("target_episodes", [-1, 0, "10", 1.5, True, None, 2**70, 1e999, [2], DELETED]),
        ("dtypes", [{"pixels": "|u1", "action": "<f4", "state": "<f4"}, {"pixels": "<f8"}, [], None, DELETED]),
        ("meta", [[], None, "x", 3, DELETED]),
        ("frames", ["jpeg", ["raw"], {}, None, 1, "webp"]),
        ("shapes", [[], None, {}, {"pixels": [3, 4, 4]}, DELETED]),
        ("version", [0, "1", True, None, [1], 1.0]),
        ("format", ["other", None, 1]),
        ("pixels", [[-3, 4, 4], [3, 0, 4], [3, 4], [3.0, 4, 4], [4, 4, 3], [1, 6, 8], [3, 2**30, 2**30], "344", None]),
        ("pixels", [[3, 2, 8], [3, 8, 2], [3, 16, 1]]),  # as many bytes a row
        ("action", [[-3], [], [3, 1], 3, [True], [2**70], [3.5]]),
        ("state", [[-2], [2, 1], 2, None]),
    ],
)
def test_a_field_that_cannot_be_is_refused_by_its_name(record, meta, name, values):
    path = record([20, 20])
    kept = (path / "meta.json").read_bytes()
    for value in values:
        change_header(path, **{name: value})
        refused(path, meta, "meta.json.*field 'shapes'" if name == "shapes" and value is DELETED else "meta.json")
        (path / "meta.json").write_bytes(kept)
    change_header(path, version=3)
    refused(path, meta, "meta.json.*format version 3, this code reads 1 and 2")


@pytest.mark.parametrize("content", [b"", b"\xa9{}", b"[" * 100_000, b"null", b"7", b'{"format": 1' + b"0" * 5000 + b"}"])
@pytest.mark.parametrize("name", ["meta.json", "episodes.jsonl"])
def test_damaged_text_is_refused_by_its_name(record, meta, name, content):
    path = record([20, 20])
    (path / name).write_bytes(content + b"\n")
    refused(path, meta, name)


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("episodes.jsonl, line 2", [{"length": length} for length in (2**63, 0, 1e999, "20", True)]),
        ("episodes.jsonl, line 2", [{"start": -20}, {"crc": -1}, {"crc": 2**32}, {"pixels_crc": 0.5}, {"more": 1}]),
        ("line 2 holds episode 3 .* expected episode 2 at row 20", [{"episode": 3}]),
        ("line 2.* expected episode 2 at row 20", [{"start": 21}]),
        ("damaged: .* bytes, the index needs", [{"length": 99}]),
    ],
)
def test_a_line_of_the_index_that_cannot_be_is_refused_by_its_number(record, meta, message, changes):
    path = record([20, 20])
    first, second = (path / "episodes.jsonl").read_text().splitlines()
    for change in changes:
        (path / "episodes.jsonl").write_text(first + "\n" + json.dumps({**json.loads(second), **change}) + "\n")
        refused(path, meta, message)


@pytest.mark.parametrize("key", ["action", "state"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused_although_checksums_fit(record, make_episode, key, value):
    path = record([20, 20])
    episode = make_episode(2)
    episode[key][5, 0] = value
    rows = np.memmap(path / f"{key}.memmap", dtype=episode[key].dtype, mode="r+", shape=(40, episode[key].shape[1]))
    rows[20:] = episode[key]
    rows.flush()
    first = (path / "episodes.jsonl").read_bytes().splitlines(keepends=True)[0]
    (path / "episodes.jsonl").write_bytes(first + IndexEntry(2, 20, 20, *checksums(episode)).to_line())
    with pytest.raises(ValueError, match=f"{path.name} holds a NaN or an infinity in '{key}' of episode 2"):
        EpisodeStore.open(path)


@pytest.mark.parametrize("name", ["meta.json", "episodes.jsonl", "pixels.memmap", "state.memmap"])
@pytest.mark.parametrize("kind", ["FIFO", "folder"])
def test_what_is_no_regular_file_is_not_waited_for(record, meta, name, kind):
    path = record([20, 20])
    (path / name).unlink()
    (os.mkfifo if kind == "FIFO" else os.mkdir)(path / name)
    refused(path, meta, f"{name} is a {kind}, expected a regular file", target=9)


@pytest.mark.parametrize("name", ["pixels.memmap", "action.memmap", "state.memmap"])
@pytest.mark.parametrize("read", [lambda data: data.sample(), lambda data: data.episode_data(1), lambda data: data[0]])
def test_a_file_that_has_shrunk_is_noticed_before_it_is_read(record, name, read):
    """Reading beyond its end would end the process by SIGBUS."""
    path = record([40] * 10)
    data = OfflineTrajectories(path, split="all", batch_size=4)
    read(data)
    os.truncate(path / name, 100)
    with pytest.raises(OSError, match=f"{name} has shrunk from [0-9]+ to 100 bytes"):
        read(data)


def raises(number):
    """A system call that fails with an error of this number."""

    def call(*_):
        raise OSError(number, os.strerror(number))

    return call


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_written_with_a_warning(tmp_path, make_episode, meta, monkeypatch, number):
    fcntl, said = pytest.importorskip("fcntl"), []
    monkeypatch.setattr(fcntl, "flock", raises(number))
    monkeypatch.setattr("torchrl.torchrl_logger.warning", said.append)
    with EpisodeWriter(tmp_path, target_episodes=1, meta=meta) as writer:
        writer.append(make_episode(1))
    assert len(said) == 1 and f"{tmp_path} cannot be locked" in said[0] and "second process" in said[0]
    assert EpisodeStore.open(tmp_path).num_episodes == 1
    monkeypatch.setattr(fcntl, "flock", raises(errno.EIO))  # other errors are errors
    descriptor = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(OSError, match="Input/output error"):
        lock_file(descriptor, tmp_path)
    os.close(descriptor)


def test_folders_that_cannot_be_synced_are_no_reason_to_stop(tmp_path, monkeypatch):
    for number in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
        monkeypatch.setattr(os, "fsync", raises(number))
        sync_directory(tmp_path)
    monkeypatch.setattr(os, "fsync", raises(errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        sync_directory(tmp_path)


def hold(path, ready, release):
    descriptor = os.open(path, os.O_RDONLY)
    lock_file(descriptor, path)
    ready.set()
    release.wait(30)
    os.close(descriptor)


def test_waiting_for_another_process_is_said_with_its_number(tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_ficreg._utils._QUIET_SECONDS", 0.1)
    fork = multiprocessing.get_context("fork")
    ready, release, said = fork.Event(), fork.Event(), []
    holder = fork.Process(target=hold, args=(tmp_path, ready, release))
    holder.start()
    assert ready.wait(30)
    descriptor = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        lock_file(descriptor, tmp_path)

    def warn(text):
        said.append(text)
        release.set()

    monkeypatch.setattr("torchrl.torchrl_logger.warning", warn)
    assert lock_file(descriptor, tmp_path, wait=True)
    os.close(descriptor)
    holder.join(30)
    (text,) = said
    assert f"waiting for {tmp_path}: another process" in text
    if os.path.exists("/proc/locks"):
        assert f"(pid {holder.pid})" in text
