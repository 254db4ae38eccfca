"""Recording, with raw and with compressed frames: at most the current episode is lost, and real damage is left as it is.

Killed at any system call, even in the middle of a write, a collection loses at most the episode being written; what remains
opens, and running the collection again ends in the very bytes of an unbroken run.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
import threading

import numpy as np
import pytest

from torchrl_ficreg.data import EpisodeStore, EpisodeWriter

TEXT = {"meta.json", "episodes.jsonl"}
DATA = {
    "raw": {"pixels.memmap", "action.memmap", "state.memmap"},
    "webp": {"pixels.blob", "pixels.offsets", "action.memmap", "state.memmap"},
}
SYSTEM_CALLS = ("write", "fsync", "replace", "ftruncate")
fork = multiprocessing.get_context("fork")  # the child inherits the imports: milliseconds instead of seconds


def content(path):
    return {file.name: file.read_bytes() for file in path.iterdir() if file.suffix != ".tmp"}


@pytest.fixture(params=["raw", "webp"])
def frames(request):
    if request.param != "raw":
        pytest.importorskip("PIL", reason="compressed frames need Pillow")
    return request.param


@pytest.fixture
def collect(make_episode, meta, frames):
    """A collection in which episode k depends on k alone, as a real one depends on (seed, k)."""

    def collect(path, target=4):
        with EpisodeWriter(path, target_episodes=target, meta=meta, frames=frames) as writer:
            for number in range(writer.num_episodes + 1, target + 1):
                writer.append(make_episode(number, length=10 + number))
            writer.finish()

    return collect


def run_killed(target, *args):
    """Runs a function in a child process and returns its exit code (-9 when it was killed)."""
    process = fork.Process(target=target, args=args)
    process.start()
    process.join(30)
    return process.exitcode


def kill_at(call, function, *args):
    """Runs a function in this process and dies at the ``call``-th system call, half-way through if it is a write."""
    count = 0
    originals = {name: getattr(os, name) for name in SYSTEM_CALLS}

    def wrap(name):
        def wrapped(*arguments):
            nonlocal count
            count += 1
            if count == call:
                if name == "write":
                    descriptor, data = arguments
                    originals["write"](descriptor, data[: len(data) // 2])
                os.kill(os.getpid(), signal.SIGKILL)
            return originals[name](*arguments)

        return wrapped

    for name in SYSTEM_CALLS:
        setattr(os, name, wrap(name))
    function(*args)
    os._exit(0)


def check_prefix(path, make_episode):
    """What is there opens, with checksums, and is a prefix of the collection. Returns the number of episodes."""
    try:
        store = EpisodeStore.open(path, allow_incomplete=True, verify="full")
    except FileNotFoundError:
        return 0
    except ValueError as error:
        assert "holds 0 of" in str(error)
        return 0
    for number in range(1, store.num_episodes + 1):
        want = make_episode(number, length=10 + number)
        rows = store.rows(number)
        np.testing.assert_array_equal(store.frames(rows), want["pixels"])
        for key in ("action", "state"):
            np.testing.assert_array_equal(store.arrays[key][rows], want[key])
    return store.num_episodes


def test_a_kill_at_any_system_call_loses_at_most_the_current_episode(tmp_path, collect, make_episode, frames):
    target = 3 if frames == "raw" else 2
    collect(tmp_path / "unbroken", target)
    unbroken = content(tmp_path / "unbroken")
    survived = []
    for call in range(1, 200):
        path = tmp_path / f"killed_{call}"
        exit_code = run_killed(kill_at, call, collect, path, target)
        survived.append(check_prefix(path, make_episode))
        collect(path, target)
        assert content(path) == unbroken, f"killed at system call {call}"
        if exit_code == 0:
            break
    assert exit_code == 0 and call > target * 2 * (len(DATA[frames]) + 1)  # a write and an fsync of each file
    assert survived == sorted(survived) and set(survived) == set(range(target + 1))


def test_a_kill_while_resuming_is_harmless_too(tmp_path, collect, make_episode, frames):
    collect(tmp_path / "unbroken")
    path = tmp_path / "killed"
    attempts, before = 0, 0
    resuming, episode = len(DATA[frames]) + 1, 2 * (len(DATA[frames]) + 1) + 2  # system calls
    while run_killed(kill_at, resuming + episode + 1, collect, path):  # commits one at a time, or dies resuming
        episodes = check_prefix(path, make_episode)
        assert episodes >= before
        before, attempts = episodes, attempts + 1
        assert attempts < 20
    assert attempts >= 3 and content(path) == content(tmp_path / "unbroken")


@pytest.mark.parametrize("call", range(1, 9))
def test_a_full_disk_leaves_the_committed_episodes(tmp_path, collect, make_episode, meta, monkeypatch, frames, call):
    collect(tmp_path / "unbroken", 3)
    write, count = os.write, 0

    def full(descriptor, data):
        nonlocal count
        count += 1
        if count == call:
            write(descriptor, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data)

    path = tmp_path / "full"
    monkeypatch.setattr(os, "write", full)
    with EpisodeWriter(path, target_episodes=3, meta=meta, frames=frames) as writer:
        while not writer.complete:
            episode = make_episode(writer.num_episodes + 1, length=11 + writer.num_episodes)
            try:
                writer.append(episode)
            except OSError as error:
                assert error.errno == errno.ENOSPC
                assert check_prefix(path, make_episode) == writer.num_episodes
    assert count > call and content(path) == content(tmp_path / "unbroken")


def test_rows_are_on_disk_before_their_index_line_is_written(tmp_path, make_episode, meta, monkeypatch, frames):
    with EpisodeWriter(tmp_path, target_episodes=2, meta=meta, frames=frames) as writer:
        writer.append(make_episode(1))
        names = {file.stat().st_ino: file.name for file in tmp_path.iterdir()}
        assert set(names.values()) == TEXT | DATA[frames]
        log = []
        for call in ("write", "fsync"):
            original = getattr(os, call)

            def logged(descriptor, *data, call=call, original=original):
                log.append((call, names[os.fstat(descriptor).st_ino]))
                return original(descriptor, *data)

            monkeypatch.setattr(os, call, logged)
        writer.append(make_episode(2))
    data, count = DATA[frames], len(DATA[frames])
    assert log[0] == ("write", "episodes.jsonl")  # a line without its end, which does not count yet
    assert log.pop(1) == ("fsync", "episodes.jsonl")  # also a power cut leaves it behind, to say how long the episode was
    assert sorted(log[1 : count + 1]) == sorted(("write", name) for name in data)
    assert sorted(log[count + 1 : 2 * count + 1]) == sorted(("fsync", name) for name in data)
    assert log[2 * count + 1 :] == [("write", "episodes.jsonl"), ("fsync", "episodes.jsonl")]


def test_a_second_writer_is_refused_until_the_first_is_gone(tmp_path, make_episode, meta):
    first = EpisodeWriter(tmp_path, target_episodes=2, meta=meta)
    first.append(make_episode(1))
    with pytest.raises(RuntimeError, match="another writer has .* open"):
        EpisodeWriter(tmp_path, target_episodes=2, meta=meta)
    first.append(make_episode(2))  # the refused one has cut nothing off
    first.close()
    with EpisodeWriter(tmp_path, target_episodes=2, meta=meta) as second:
        assert second.complete and second.num_steps == 40


def test_a_waiting_writer_begins_when_the_first_is_done(tmp_path, make_episode, meta):
    """Two runs started at once share one recording: it is made once."""
    first = EpisodeWriter(tmp_path, target_episodes=2, meta=meta)
    first.append(make_episode(1))
    found = []

    def record():
        with EpisodeWriter(tmp_path, target_episodes=2, meta=meta, wait=True) as writer:
            found.append(writer.num_episodes)

    waiting = threading.Thread(target=record)
    waiting.start()
    first.append(make_episode(2))
    assert not found
    first.close()
    waiting.join(timeout=10)
    assert found == [2]


@pytest.mark.parametrize(
    "change, field",
    [({"seed": 1}, "seed = 0, got 1"), ({"env_kwargs": {"noise": 2.0}}, "env_kwargs"), ({"expert": "x"}, "expert")],
)
def test_other_settings_are_refused_by_name(record, meta, change, field):
    path = record([20])
    before = content(path)
    with pytest.raises(ValueError, match=field):
        EpisodeWriter(path, target_episodes=1, meta={**meta, **change})
    assert content(path) == before


def test_only_the_target_may_grow(record, make_episode, meta):
    path = record([20, 20])
    with pytest.raises(ValueError, match="target may only grow"):
        EpisodeWriter(path, target_episodes=1, meta=meta)
    with EpisodeWriter(path, target_episodes=3, meta=meta) as writer:
        assert writer.num_episodes == 2 and not writer.complete and writer.append(make_episode(3)) == 3
    assert EpisodeStore.open(path).num_episodes == 3


def test_meta_survives_json_and_the_order_of_nested_settings_does_not_matter(tmp_path, make_episode):
    meta = {"action_low": np.array([-1.0, -np.inf]), "size": (4, 4), "seed": np.int64(3), "path": tmp_path}
    for expert in ({"noise": 1, "kind": "a"}, {"kind": "a", "noise": 1}):  # the second one compares with the first one's
        with EpisodeWriter(tmp_path / "d", target_episodes=2, meta={**meta, "expert": expert}) as writer:
            writer.append(make_episode(writer.num_episodes))
    read = EpisodeStore.open(tmp_path / "d").header.meta
    assert {key: read[key] for key in meta} == {**meta, "action_low": [-1.0, -np.inf], "size": [4, 4], "path": str(tmp_path)}
    with pytest.raises(TypeError, match="got a object"):
        EpisodeWriter(tmp_path / "e", target_episodes=1, meta={"expert": object()})


@pytest.mark.parametrize("tail", [b'{"episode": 3, "start"', b"\x00" * 50, b'{"episode": 3}'])
def junk(tail):
    """Appends what a crash can leave behind the data."""
    tails = {"episodes.jsonl": tail, "pixels.memmap": b"half a frame", "state.memmap": b"123"}
    return lambda files: {name: files[name] + tail for name, tail in tails.items()}


def lost_rows(files):
    """As after a power cut that left zeros where the rows were to be."""
    index, rows = files["episodes.jsonl"], files["pixels.memmap"]
    return {"episodes.jsonl": index[:-1], "pixels.memmap": rows[: len(rows) // 2] + bytes(len(rows) // 2)}


def lost_files(line):
    """As after a power cut in the first episode, however long it was, and whatever the notes say of it."""
    none = {"action.memmap": b"", "state.memmap": b""}
    return lambda files: {
        "episodes.jsonl": files["episodes.jsonl"][:-1] if line is None else line,
        "pixels.memmap": files["pixels.memmap"][: 13 * 48 + 5],
        **none,
    }


@pytest.mark.parametrize(
    ("count", "damage", "left"),
    [(2, junk(tail), 2) for tail in (b'{"episode": 3, "start"', b"\x00" * 50, b'{"episode": 3}')]
    + [(2, lost_rows, 1)]
    + [(1, lost_files(line), 0) for line in (b"", b'{"episode": 1, "st', None)],
)
def test_what_is_torn_is_cut_off_and_recorded_again(record, make_episode, meta, count, damage, left):
    """An episode that is not whole does not count, and none that is whole is lost."""
    path = record([20] * count, target=count if left < count else 3)
    whole = content(path)
    for name, data in damage(whole).items():
        (path / name).write_bytes(data)
    if left == count:
        assert EpisodeStore.open(path, allow_incomplete=True, verify="full").num_episodes == count
    with EpisodeWriter(path, target_episodes=count if left < count else 3, meta=meta) as writer:
        assert (writer.num_episodes, writer.num_steps) == (left, 20 * left)
        for number in range(left, count):
            writer.append(make_episode(number + 1))
        assert content(path) == whole


def unfitting(index):
    """Cuts the last line of an index, and makes what is left of it wrong."""
    first, second = index.splitlines(keepends=True)
    return first + second[:-20].replace(b'"length": 20', b'"length": 21')


@pytest.mark.parametrize(
    ("frames", "name", "change", "message"),
    [
        ("raw", "pixels.memmap", lambda data: data[:-1], "pixels.memmap is damaged: 1919 bytes, the index needs 1920"),
        ("raw", "state.memmap", None, "has lost state.memmap: restore it"),
        ("raw", "episodes.jsonl", None, "has lost episodes.jsonl: restore it"),  # it would look empty, and be made so
        ("raw", "episodes.jsonl", unfitting, "torn line that does not fit the 20 rows"),
        ("raw", "meta.json", None, "index but no meta.json"),
        *[
            row
            for name in ("pixels.blob", "pixels.offsets")
            for row in (
                ("png", name, lambda data: data[:-1], f"{name} is damaged: [0-9]+ bytes, the index needs"),
                ("png", name, lambda data: b"", f"{name} is damaged: 0 bytes, the index needs"),
                ("png", name, None, f"has lost {name}"),
            )
        ],
    ],
)
def test_a_writer_does_not_repair_damage_by_losing_episodes(record, meta, frames, name, change, message):
    path = record([20, 20], target=3, frames=frames)
    data = (path / name).read_bytes()
    (path / name).unlink()
    if change:
        (path / name).write_bytes(change(data))
    before = content(path)
    with pytest.raises(ValueError, match=message):
        EpisodeWriter(path, target_episodes=3, meta=meta, frames=frames)
    assert content(path) == before
    if name.startswith("pixels"):
        with pytest.raises(ValueError, match=f"{name} is damaged"):
            EpisodeStore.open(path, allow_incomplete=True)


def test_what_cannot_be_recorded_is_refused_and_leaves_no_trace(tmp_path, make_episode, meta):
    good = make_episode(1)
    with EpisodeWriter(tmp_path, target_episodes=2, meta=meta) as writer:
        with pytest.raises(ValueError, match="NaN"):
            writer.append({**good, "state": np.full((20, 2), np.nan)})
        with pytest.raises(TypeError, match="'state' must be a numpy array, got a list"):
            writer.append({**good, "state": good["state"].tolist()})
        with pytest.raises(ValueError, match="action must be zero"):
            writer.append({**good, "action": np.ones((20, 3), np.float32)})
        writer.append(good)
        with pytest.raises(ValueError, match="row shapes must stay"):
            writer.append(make_episode(2, size=8))
        with pytest.raises(RuntimeError, match="1 of 2 episodes"):
            writer.finish()
        with pytest.raises(RuntimeError, match="closed"):
            writer.append(good)
    with EpisodeWriter(tmp_path, target_episodes=2, meta=meta) as writer:
        writer.append(make_episode(2))
        with pytest.raises(RuntimeError, match="holds its 2 episodes"):
            writer.append(make_episode(3))
    with pytest.raises(FileExistsError, match="already holds a dataset"):
        EpisodeWriter(tmp_path, target_episodes=2, meta=meta, resume=False)
    with pytest.raises(ValueError, match="at least 1"):
        EpisodeWriter(tmp_path / "x", target_episodes=0, meta=meta)


def test_non_contiguous_arrays_are_stored_as_they_read(tmp_path, make_episode, meta):
    episode = make_episode(1)
    strided = {**episode, "pixels": np.ascontiguousarray(episode["pixels"].transpose(0, 2, 3, 1)).transpose(0, 3, 1, 2)}
    with EpisodeWriter(tmp_path, target_episodes=1, meta=meta) as writer:
        writer.append(strided)
    np.testing.assert_array_equal(EpisodeStore.open(tmp_path, verify="full").arrays["pixels"], episode["pixels"])


def smaller_frames(text):
    notes = json.loads(text)
    notes["shapes"]["pixels"] = [3, 4, 2]
    return json.dumps(notes).encode()


@pytest.mark.parametrize("target", [5, 9])
@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("meta.json", lambda text: text.replace(b'"target_episodes": 5', b'"target_episodes": 4')),
        ("meta.json", smaller_frames),
        ("episodes.jsonl", lambda index: index[: len(index) // 2]),
        ("episodes.jsonl", lambda index: b""),
    ],
    ids=["digit", "frames", "half", "empty"],
)
def test_damaged_notes_never_cut_data(record, meta, name, damage, target):
    """Header and index are what says how much is data: where they disagree with the files, nothing is changed."""
    path = record([20, 20, 20, 20, 20])
    (path / name).write_bytes(damage((path / name).read_bytes()))
    before = content(path)
    try:
        EpisodeWriter(path, target_episodes=target, meta=meta).close()
    except ValueError as error:
        assert str(path) in str(error) and len(str(error).splitlines()) == 1
    after = content(path)
    assert all(after[file] == before[file] for file in before if file.endswith("memmap"))


def test_links_are_not_written_through(record, meta, tmp_path):
    path = record([20, 20])
    victim = tmp_path / "victim"
    victim.write_bytes(bytes(100_000))
    for name in ("action.memmap", "episodes.jsonl"):
        kept = (path / name).read_bytes()
        (path / name).unlink()
        (path / name).symlink_to(victim)
        with pytest.raises(ValueError, match="damaged|invalid|a link"):
            EpisodeWriter(path, target_episodes=9, meta=meta)
        assert victim.read_bytes() == bytes(100_000)
        (path / name).unlink()
        (path / name).write_bytes(kept)
    (path / "meta.json.tmp").symlink_to(victim)
    EpisodeWriter(path, target_episodes=9, meta=meta).close()
    assert victim.read_bytes() == bytes(100_000)


def test_a_complete_dataset_is_not_opened_for_writing(record, meta, monkeypatch):
    path = record([20, 20], target=2)
    original = os.open

    def refused(file, flags, *rest, **options):
        if flags & (os.O_RDWR | os.O_WRONLY):
            raise PermissionError(file)
        return original(file, flags, *rest, **options)

    monkeypatch.setattr(os, "open", refused)
    with EpisodeWriter(path, target_episodes=2, meta=meta) as writer:
        assert writer.complete and writer.num_steps == 40


@pytest.mark.parametrize("frames", ["raw", "png"])
def test_episodes_without_a_state_are_stored_and_opened(tmp_path, make_episode, meta, frames):
    episode = {**make_episode(1), "state": np.zeros((20, 0))}
    for target in (1, 2):  # opened anew in between
        with EpisodeWriter(tmp_path, target_episodes=target, meta=meta, frames=frames) as writer:
            writer.append(episode)
    store = EpisodeStore.open(tmp_path, verify="full")
    assert store.num_episodes == 2 and store.arrays["state"].shape == (40, 0)
    with pytest.raises(ValueError, match="holds no state"):
        store.require_state()


@pytest.mark.parametrize("missing", range(1, 82, 8))
@pytest.mark.parametrize("number", [1, 3])
def test_a_torn_line_behind_which_the_rows_are_whole_costs_no_episode(tmp_path, collect, meta, frames, number, missing):
    """The line is on the disk before the rows: where they are whole the index was damaged, and no crash cut it short."""
    collect(tmp_path, number)
    before = content(tmp_path)
    (tmp_path / "episodes.jsonl").write_bytes(before["episodes.jsonl"][:-missing])
    with EpisodeWriter(tmp_path, target_episodes=number, meta=meta, frames=frames) as writer:
        assert writer.complete
    assert content(tmp_path) == before
