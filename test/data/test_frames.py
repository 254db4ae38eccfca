"""Compressed and raw frames: the same bytes, batches and fingerprint; damage is reported; a batch belongs to the caller."""

from __future__ import annotations

import json
import multiprocessing
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import EpisodeStore, EpisodeWriter, estimate_bytes, OfflineTrajectories
from torchrl_ficreg.data.frames import (
    BufferPool,
    check_frame_format,
    default_threads,
    encode_frames,
    ImageFrames,
    RawFrames,
    run_split,
)

pytest.importorskip("PIL", reason="compressed frames need Pillow")

META = {"env": "two_room", "seed": 0}
LENGTHS = [20, 31, 25]


@pytest.fixture
def write(tmp_path):
    """``write(frames)`` records three episodes of random blocks and returns the directory and the episodes."""

    def write(frames, *, size=(9, 16), target=3, name=None):
        random = np.random.default_rng(0)
        episodes = []
        for length in LENGTHS[:target]:
            action = random.normal(size=(length, 2)).astype(np.float32)
            action[-1] = 0
            pixels = random.integers(0, 256, (length, 3, *size), dtype=np.uint8)
            episodes.append({"pixels": pixels, "action": action, "state": random.normal(size=(length, 4))})
        path = tmp_path / (name or frames)
        with EpisodeWriter(path, target_episodes=target, meta=META, frames=frames) as writer:
            for episode in episodes:
                writer.append(episode)
        return path, episodes

    return write


def pictures():
    """Pictures that a codec may be tempted to simplify: noise, flats, one odd pixel, steep edges."""
    random = np.random.default_rng(1)
    noise = random.integers(0, 256, (2, 3, 17, 30), dtype=np.uint8)
    flat = np.stack([np.full((3, 17, 30), value, np.uint8) for value in (0, 1, 254, 255)])
    odd = flat.copy()
    odd[:, 1, 8, 29] ^= 1
    edges = np.where(np.arange(30) % 2, 255, 0).astype(np.uint8) * np.ones((1, 3, 17, 1), np.uint8)
    return np.concatenate([noise, flat, odd, edges])


@pytest.mark.parametrize("frames", ["webp", "png"])
@pytest.mark.parametrize("num_threads", [1, 3])
def test_compression_loses_nothing(frames, num_threads):
    pixels = pictures()
    images = encode_frames(pixels, frames, num_threads=num_threads)
    assert images == encode_frames(pixels, frames, num_threads=1)
    reader = ImageFrames(
        b"".join(images), np.cumsum([len(i) for i in images]), pixels.shape[1:], frames, num_threads=num_threads
    )
    assert len(reader) == len(pixels)
    for rows in (np.arange(11), np.array([[10, 3], [0, 3]]), np.array(7), np.array([], np.int64)):
        np.testing.assert_array_equal(reader.read(rows), pixels[rows])
    np.testing.assert_array_equal(reader.read(slice(3, 9, 2)), pixels[3:9:2])
    for row in (-1, 11):
        with pytest.raises(IndexError, match="rows run from 0 to 10"):
            reader.read(np.array([0, row]))


@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_raw_frames_are_gathered_as_by_indexing(num_threads):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 3, 200, 100), dtype=np.uint8)
    reader = RawFrames(pixels, num_threads=num_threads)
    rows = np.random.default_rng(1).integers(0, 40, (3, 80))  # 14 MB: several pieces
    np.testing.assert_array_equal(reader.read(rows), pixels[rows])
    np.testing.assert_array_equal(RawFrames(pixels.transpose(0, 1, 3, 2)).read(rows), pixels[rows].swapaxes(-1, -2))
    assert np.shares_memory(reader.read(slice(2, 5)), pixels)
    for row in (-1, 40):
        with pytest.raises(IndexError, match="rows run from 0 to 39"):
            reader.read(np.array([row]))
    for rows in (np.array([True, False]), np.array([0.0, 1.0])):
        with pytest.raises(TypeError, match="rows are picked by integers"):
            reader.read(rows)


@pytest.mark.parametrize("frames", ["webp", "png"])
def test_only_the_files_differ(write, frames):
    (raw_path, episodes), (path, _) = write("raw"), write(frames)
    raw = EpisodeStore.open(raw_path, verify="full")
    assert raw.fingerprint == EpisodeStore.from_episodes(episodes).fingerprint
    rows = np.random.default_rng(0).integers(0, raw.num_steps, (5, 4))
    for num_threads in (None, 1, 4):
        store = EpisodeStore.open(path, verify="full", num_threads=num_threads)
        assert store.header.frames == frames and store.fingerprint == raw.fingerprint
        assert set(store.arrays) == {"action", "state"}
        np.testing.assert_array_equal(store.frames(slice(None)), raw.arrays["pixels"])
        np.testing.assert_array_equal(store.frames(rows), raw.frames(rows))
    names, raw_names = ({file.name for file in folder.iterdir()} for folder in (path, raw_path))
    assert names ^ raw_names == {"pixels.memmap", "pixels.blob", "pixels.offsets"}
    header = json.loads((path / "meta.json").read_text())
    assert header["version"] == 2 and header["frames"] == frames  # code that reads version 1 only refuses it
    with pytest.raises(ValueError, match="num_threads must be at least 1, got 0"):
        EpisodeStore.open(path, num_threads=0)
    options = {"split": "all", "num_frames": 3, "frame_skip": 4, "batch_size": 8, "seed": 3}
    keys = ("pixels", "action", "state", "episode", "step")
    ours, theirs = (OfflineTrajectories(place, keys=keys, **options) for place in (raw_path, path))
    for _ in range(2 * ours.batches_per_epoch):
        first, second = ours.sample(), theirs.sample()
        assert set(first.keys()) == set(second.keys()) and (first == second).all()
    assert (ours.episode_data(2) == theirs.episode_data(2)).all()


def test_parts_of_an_episode_are_cut_from_the_whole(write):
    for frames in ("raw", "webp"):
        dataset = OfflineTrajectories(write(frames)[0], split="all", num_frames=2, frame_skip=1)
        whole = dataset.episode_data(3)
        for steps in (slice(4, 5), slice(3, 20, 4), slice(20, None), slice(-3, None), slice(9, 9)):
            part = dataset.episode_data(3, steps=steps)
            assert part.shape == whole[steps].shape and (part == whole[steps]).all()
        assert set(dataset.episode_data(1, keys=("state",)).keys()) == {"state", "episode", "step", "next"}


def test_a_dataset_keeps_the_format_it_was_begun_with(write, make_episode):
    path, episodes = write("webp", target=2)
    with pytest.raises(ValueError, match="was begun with frames = webp, got raw"):
        EpisodeWriter(path, target_episodes=3, meta=META)
    with EpisodeWriter(path, target_episodes=3, meta=META, frames="webp") as writer:
        with pytest.raises(ValueError, match="row shapes must stay"):
            writer.append(make_episode(1))
        writer.append({key: value[:12] * (key != "action") for key, value in episodes[0].items()})
    store = EpisodeStore.open(path, verify="full")
    np.testing.assert_array_equal(store.frames(store.rows(3)), episodes[0]["pixels"][:12])
    with pytest.raises(ValueError, match=r"frames must be one of .*, got 'jpeg'"):
        EpisodeWriter(path, target_episodes=3, meta=META, frames="jpeg")


def test_datasets_of_before_frames_had_a_format_are_raw(write):
    path, episodes = write("raw")
    header = json.loads((path / "meta.json").read_text())
    assert header["version"] == 1 and header.pop("frames") == "raw"  # code of then reads raw datasets of now
    (path / "meta.json").write_text(json.dumps(header))
    store = EpisodeStore.open(path, verify="full")
    np.testing.assert_array_equal(store.frames(slice(20, 51)), episodes[1]["pixels"])
    with EpisodeWriter(path, target_episodes=4, meta=META) as writer:
        writer.append(episodes[0])
    assert EpisodeStore.open(path, verify="full").num_episodes == 4


@pytest.mark.parametrize("frames", ["webp", "png"])
def test_a_damaged_image_is_reported(write, frames):
    path, _ = write(frames)
    blob = (path / "pixels.blob").read_bytes()
    ends = np.fromfile(path / "pixels.offsets", "<i8")
    for row, episode in ((3, 1), (75, 3)):
        middle = int(ends[row] + ends[row - 1]) // 2
        (path / "pixels.blob").write_bytes(blob[:middle] + bytes(8) + blob[middle + 8 :])
        with pytest.raises(ValueError, match=f"image of row {row} is damaged|bytes of episode {episode} do not match"):
            EpisodeStore.open(path)
        EpisodeStore.open(path, verify="none").frames(np.setdiff1d(np.arange(76), row))
    (path / "pixels.blob").write_bytes(blob[: ends[5]] + bytes(ends[6] - ends[5]) + blob[ends[6] :])
    with pytest.raises(ValueError, match="image of row 6 is damaged .*: restore the files or collect again"):
        EpisodeStore.open(path, verify="none").frames(np.array([5, 6, 7]))
    (path / "pixels.blob").write_bytes(blob)
    swapped, shifted = ends.copy(), ends.copy()
    swapped[[4, 5]] = ends[[5, 4]]
    shifted[4] -= 9
    for offsets, message in (
        (swapped, "pixels.offsets is damaged: the image of row 5 ends"),
        (shifted, "image of row [45] is damaged"),
    ):
        offsets.tofile(path / "pixels.offsets")
        with pytest.raises(ValueError, match=message):
            EpisodeStore.open(path)


def test_every_cut_of_the_files_opens_or_is_refused(write):
    """What a crash can leave: any part of the third episode in any file. The first two are served either way."""
    path, episodes = write("webp")
    two, _ = write("webp", target=2, name="two")
    small = {file.name: file.stat().st_size for file in two.iterdir()}
    whole = {file.name: file.read_bytes() for file in path.iterdir()}
    lines = whole["episodes.jsonl"].splitlines(keepends=True)
    for name in ("pixels.blob", "pixels.offsets", "action.memmap", "state.memmap", "episodes.jsonl"):
        for cut in (small[name], small[name] + 1, (small[name] + len(whole[name])) // 2, len(whole[name])):
            for file, data in whole.items():
                (path / file).write_bytes(data)
            (path / "episodes.jsonl").write_bytes(b"".join(lines[:2]))  # the line comes last
            (path / name).write_bytes(whole[name][:cut])
            store = EpisodeStore.open(path, allow_incomplete=True, verify="full")
            done = 3 if name == "episodes.jsonl" and cut == len(whole[name]) else 2
            assert store.num_episodes == done
            with EpisodeWriter(path, target_episodes=3, meta=META, frames="webp") as writer:
                for number in range(writer.num_episodes, 3):
                    writer.append(episodes[number])
            assert {file.name: file.read_bytes() for file in path.iterdir()} == whole


def test_a_forked_process_reads_the_same_frames(write):
    store, rows = EpisodeStore.open(write("webp")[0], num_threads=3), np.arange(60)
    expected = store.frames(rows)  # the threads now run in this process, and do not in a forked one
    with multiprocessing.get_context("fork").Pool(1) as pool:
        np.testing.assert_array_equal(pool.apply_async(EpisodeStore.frames, (store, rows)).get(timeout=300), expected)


@pytest.mark.parametrize("frames", ["raw", "webp"])
def test_a_batch_belongs_to_the_caller(write, frames):
    path, _ = write(frames, size=(96, 96))
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    dataset = OfflineTrajectories(path, split="all", num_frames=4, frame_skip=2, batch_size=32, shuffle=False)
    first = dataset.sample()  # 3.5 MB of frames: more than the allocator would keep
    expected = first["pixels"].clone()
    for _ in range(5):
        other = dataset[torch.arange(32)]["pixels"]
        assert other.equal(expected) and other.data_ptr() != first["pixels"].data_ptr()
        other.zero_()
        assert first["pixels"].equal(expected)
    dataset.episode_data(1)["pixels"].zero_()
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


KEEP_ALIVE = {
    "a view": lambda array: array[1],
    "a reshaped view": lambda array: array.reshape(-1)[5:],
    "a view as other numbers": lambda array: array.view(np.int32),
    "a transposed view of a view": lambda array: array[1:].transpose(1, 0),
    "a memoryview": memoryview,
    "a tensor": torch.from_numpy,
    "a slice of a tensor": lambda array: torch.from_numpy(array)[1:, 3],
    "an array of a tensor of an array": lambda array: torch.from_numpy(array).view(-1).numpy()[7:],
    "a tensor behind dlpack": lambda array: torch.from_dlpack(torch.from_numpy(array).view(-1)),
    "an attribute of an iterator": iter,
}


@pytest.mark.parametrize("how", KEEP_ALIVE)
def test_a_buffer_waits_for_its_last_user(how):
    for released in (False, True):
        pool = BufferPool(keep=1, smallest=1)
        array = pool.empty((4, 8))
        address, users = array.ctypes.data, [KEEP_ALIVE[how](array)]
        del array
        if released:
            users.clear()
        assert (pool.empty((4, 8)).ctypes.data == address) == released


def test_a_pool_keeps_few_buffers_and_threads_never_share_one():
    pool = BufferPool(keep=2, smallest=8)
    arrays = [pool.empty((8,)) for _ in range(5)]
    assert len({array.ctypes.data for array in arrays}) == 5
    del arrays
    assert len(pool._free) == 2
    pool.empty((16,))  # another batch size: the old blocks go
    assert [memory.size for memory in pool._free] == [16]
    assert pool.empty((4,)).size == 4 and [memory.size for memory in pool._free] == [16]
    shared = BufferPool(smallest=1)

    def hold(number):
        for _ in range(300):
            array = shared.empty((64,))
            array[:] = number
            assert (array[::-1] == number).all()

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(hold, range(8)))


@pytest.mark.parametrize("num_threads", [1, 2, 7])
@pytest.mark.parametrize("count, smallest", [(0, 1), (1, 1), (100, 1), (100, 30), (100, 1000)])
def test_split_work_covers_every_item_once_and_raises_errors_of_threads(num_threads, count, smallest):
    seen = np.zeros(count, int)

    def work(start, stop):
        seen[start:stop] += 1

    def fail(start, stop):
        if start <= count // 2 < stop:
            raise KeyError("the middle")

    run_split(work, count, num_threads=num_threads, smallest=smallest)
    assert (seen == 1).all() and default_threads() >= 1
    if count:
        with pytest.raises(KeyError, match="the middle"):
            run_split(fail, count, num_threads=num_threads, smallest=smallest)


def test_without_pillow_the_error_names_the_extra(write, monkeypatch):
    for name in ("PIL", "PIL.features", "PIL.PngImagePlugin", "PIL.WebPImagePlugin"):
        monkeypatch.setitem(sys.modules, name, None)
    path, _ = write("raw")
    EpisodeStore.open(path)
    with pytest.raises(ImportError, match=r"needs Pillow: pip install 'torchrl_ficreg\[data\]'"):
        EpisodeWriter(path.parent / "new", target_episodes=1, meta=META, frames="webp")
    assert not (path.parent / "new").exists()
    with pytest.raises(ValueError, match="raw frames are not encoded"):
        encode_frames(np.zeros((1, 3, 2, 2), np.uint8), "raw")
    check_frame_format("raw")


@pytest.mark.parametrize("size", [64, 224])
def test_the_estimate_is_on_the_safe_side_of_our_environments(size, tmp_path):
    from torchrl_ficreg.envs.collect import collect_episodes

    (episode,) = collect_episodes("two_room", 1, num_workers=0, image_size=size, max_steps=20)
    length = len(episode["action"])
    for frames in ("raw", "png", "webp"):
        path = tmp_path / frames
        with EpisodeWriter(path, target_episodes=1, meta=META, frames=frames) as writer:
            writer.append(episode)
        size_on_disk = sum(file.stat().st_size for file in path.iterdir() if file.suffix not in (".json", ".jsonl"))
        estimate = estimate_bytes(length, size, 2, episode["state"].shape[1], frames)
        assert estimate == estimate_bytes(length, (size, size), 2, episode["state"].shape[1], frames)
        assert (size_on_disk == estimate) if frames == "raw" else (size_on_disk < estimate < length * 3 * size**2 / 2)
