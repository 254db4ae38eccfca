"""Clips per second of every storage format: a table, and docs/results/clip_sampling.json.

All formats serve batches of 128 clips of 4 frames, 5 rows apart, from the same TwoRoom frames in the page cache. They alternate
within one run, so that other load slows all of them; each time is the least of the repeats. "x ours" is relative to this
package's sampling of raw frames, or, for formats that are given row numbers ("by index"), to its reading of clips.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage

from torchrl_ficreg._device import describe_processor
from torchrl_ficreg.data import EpisodeStore, EpisodeWriter, OfflineTrajectories
from torchrl_ficreg.envs.collect import collect_episodes

RESULT = Path(__file__).resolve().parents[1] / "docs" / "results" / "clip_sampling.json"
CLIPS, FRAMES, SKIP, LENGTH = 128, 4, 5, 100
SPAN = (FRAMES - 1) * SKIP + 1  # rows from the first frame of a clip to its last
ROWS = {64: 12_000, 224: 2_000}
SLOW = {"HDF5, 100-row chunks", "SliceSampler, 16 rows", "SliceSampler, 20 rows"}  # a few repeats are enough
Draw = Callable[[np.ndarray], object]  # first rows [128] -> a batch


def main() -> None:
    """Measures every size with every number of threads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 224])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--only", nargs="*", help="prefixes of the names of the formats; default: all")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    results = []
    for size in arguments.sizes:
        with tempfile.TemporaryDirectory() as folder:
            episodes = record(size)
            stored = prepare(Path(folder), episodes, arguments.only)
            for threads in arguments.threads:
                table = measure(ways(Path(folder), stored, threads), arguments.repeats, threads)
                results.append({"size": size, "threads": threads, "ways": summarise(table, stored, len(episodes))})
                show(results[-1])
    header = {"clips": CLIPS, "frames": FRAMES, "frame_skip": SKIP, "repeats": arguments.repeats}
    machine = {"machine": describe_processor(), "cores": len(os.sched_getaffinity(0)), "torch": torch.__version__}
    arguments.out.write_text(json.dumps({**header, **machine, "results": results}, indent=2) + "\n")


def record(size: int) -> list[dict[str, np.ndarray]]:
    """Episodes of 100 rows, cut from concatenated TwoRoom recordings."""
    recorded, count = [], 0
    for episode in collect_episodes("two_room", 10_000, num_workers=0, image_size=size):
        recorded.append(episode)
        count += len(episode["action"])
        if count >= ROWS[size]:
            break
    columns = [np.concatenate(column) for column in zip(*(episode.values() for episode in recorded))]
    episodes = []
    for start in range(0, ROWS[size], LENGTH):
        rows = (column[start : start + LENGTH].copy() for column in columns)
        episodes.append(dict(zip(("pixels", "action", "state"), rows)))
        episodes[-1]["action"][-1] = 0
    return episodes


def prepare(folder: Path, episodes: list[dict[str, np.ndarray]], only: list[str] | None) -> dict[str, int]:
    """Writes every installed and requested format: name -> bytes on disk."""
    pixels = np.concatenate([episode["pixels"] for episode in episodes])  # [N, 3, H, W]
    stored: dict[str, int] = {}
    for frames in ("raw", "webp", "png"):
        if wanted(frames, only):
            with EpisodeWriter(folder / frames, target_episodes=len(episodes), meta={}, frames=frames) as writer:
                for episode in episodes:
                    writer.append(episode)
            stored[frames] = size_of(folder / frames, "pixels.*")
    if wanted("TensorStorage", only) or wanted("SliceSampler", only):
        columns = {key: torch.from_numpy(np.concatenate([e[key] for e in episodes])) for key in ("pixels", "action")}
        columns["episode"] = torch.arange(len(pixels)) // LENGTH
        TensorDict(columns, [len(pixels)]).memmap_(str(folder / "tensordict"))
        stored["tensordict"] = size_of(folder / "tensordict", "pixels.*")
    for name, write in (("HDF5", write_hdf5), ("Lance", write_lance)):
        if wanted(name, only):
            try:
                write(folder, pixels.transpose(0, 2, 3, 1))
            except ImportError as error:
                print(f"{name} left out: {error}")
                continue
            stored[name] = size_of(folder, f"{name.lower()}*")
    return stored


def write_hdf5(folder: Path, images: np.ndarray) -> None:
    """The layout of the official files, and the same with a chunk per row."""
    import h5py
    import hdf5plugin

    for chunk in (100, 1):
        with h5py.File(folder / f"hdf5_{chunk}.h5", "w") as file:
            options = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)
            file.create_dataset("pixels", data=images, chunks=(chunk, *images.shape[1:]), **options)


def write_lance(folder: Path, images: np.ndarray) -> None:
    """One row per frame with a JPEG of quality 95, as stable-worldmodel writes them."""
    import lance
    import pyarrow
    from PIL import Image

    def encode(image: np.ndarray) -> bytes:
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(image)).save(file, "JPEG", quality=95)
        return file.getvalue()

    column = pyarrow.array([encode(image) for image in images], pyarrow.binary())
    lance.write_dataset(pyarrow.table({"pixels": column}), str(folder / "lance.lance"))


def ways(folder: Path, stored: dict[str, int], threads: int) -> dict[str, Draw]:
    """Name -> a function that draws one batch."""
    result: dict[str, Draw] = {}
    for frames in ("raw", "webp", "png"):
        if frames in stored:
            store = EpisodeStore.open(folder / frames, verify="none", num_threads=threads)
            options = {"split": "all", "num_frames": FRAMES, "frame_skip": SKIP, "batch_size": CLIPS}
            dataset = OfflineTrajectories(store, **options)
            result[f"ours, {frames}"] = lambda first, dataset=dataset: dataset.sample()
            if frames == "raw":
                touch(store.arrays["pixels"])
                result["ours, raw, by index"] = lambda first, clips=dataset._storage: clips.get(clip_numbers(first))
    if "tensordict" in stored:
        rows = TensorDict.load_memmap(str(folder / "tensordict"))
        touch(rows["pixels"].numpy())
        storage = TensorStorage(rows)
        result["TensorStorage, by index"] = lambda first: storage.get(torch.from_numpy(clip_rows(first)))
        for span in (SPAN, FRAMES * SKIP):  # 20 rows: with the actions of the last block, as ours has them
            result[f"SliceSampler, {span} rows"] = slices(rows, span)
    for chunk in (100, 1):
        if "HDF5" in stored:
            result[f"HDF5, {chunk}-row chunks"] = hdf5(folder / f"hdf5_{chunk}.h5")
    if "Lance" in stored:
        result["Lance, JPEG"] = lance_table(folder / "lance.lance", threads)
    return result


def touch(pixels: np.ndarray) -> None:
    """Reads a byte of every page, so that no page fault is timed."""
    pixels.reshape(-1)[::4096].max()


def slices(rows: TensorDict, span: int) -> Draw:
    """Samples contiguous rows with SliceSampler; the frames in between are dropped afterwards."""
    sampler = SliceSampler(slice_len=span, traj_key="episode", cache_values=True)
    buffer = TensorDictReplayBuffer(storage=TensorStorage(rows), sampler=sampler, batch_size=CLIPS * span)
    return lambda first: buffer.sample().reshape(CLIPS, span)[:, ::SKIP]


def hdf5(path: Path) -> Draw:
    """One read per frame: a strided slice takes h5py over a hundred times as long.

    The cache holds four chunks of 100 frames, a small part of the file, as with a dataset of real size.
    """
    import h5py

    pixels = h5py.File(path, "r", rdcc_nbytes=1 << 26)["pixels"]
    return lambda first: np.stack([pixels[row] for row in clip_rows(first).ravel()])


def lance_table(path: Path, threads: int) -> Draw:
    """One take per batch, decoded in parallel."""
    import lance
    from PIL import Image

    table, pool = lance.dataset(str(path)), ThreadPoolExecutor(threads)

    def draw(first: np.ndarray) -> np.ndarray:
        cells = table.take(clip_rows(first).ravel().tolist(), columns=["pixels"])["pixels"].to_pylist()
        return np.stack(list(pool.map(lambda cell: np.asarray(Image.open(io.BytesIO(cell))), cells)))

    return draw


def measure(ways: dict[str, Draw], repeats: int, threads: int) -> dict[str, list[float]]:
    """Seconds of every repeat; the formats alternate."""
    torch.set_num_threads(threads)
    random = np.random.default_rng(0)
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for repeat in range(-2, repeats):  # two rounds to warm up
        for name, draw in ways.items():
            if name in SLOW and not -1 <= repeat < 4:
                continue
            first = random.integers(0, 20, CLIPS) * LENGTH + random.integers(0, LENGTH - SPAN + 1, CLIPS)
            time.sleep(0.1)  # threads of the previous format stay active: OpenMP's spin, Lance's read ahead
            begin = time.perf_counter()
            batch = draw(first)
            elapsed = time.perf_counter() - begin
            del batch
            if repeat >= 0:
                seconds[name].append(elapsed)
    return seconds


def summarise(table: dict[str, list[float]], stored: dict[str, int], num_episodes: int) -> dict[str, dict[str, float]]:
    """Minimum and median time, clips per second, time relative to this package, and bytes on disk per frame."""
    sizes = {"TensorStorage": "tensordict", "SliceSampler": "tensordict"}
    result = {}
    for name, seconds in table.items():
        key = name.removeprefix("ours, ").split(",")[0]
        files = stored[sizes.get(key, key)] / (2 if key == "HDF5" else 1)  # two files of about one size
        ours = min(table["ours, raw, by index" if "by index" in name else "ours, raw"])
        result[name] = {
            "milliseconds": round(1e3 * min(seconds), 2),
            "median_milliseconds": round(1e3 * float(np.median(seconds)), 2),
            "clips_per_second": round(CLIPS / min(seconds)),
            "times_ours": round(min(seconds) / ours, 2),
            "bytes_per_frame": round(files / (num_episodes * LENGTH)),
        }
    return result


def show(result: dict) -> None:
    """Prints one table."""
    print(f"\n{result['size']} px, {result['threads']} thread(s)")
    print(f"{'':24s}{'clips/s':>9s}{'ms':>9s}{'median':>9s}{'x ours':>9s}{'bytes/frame':>13s}")
    for name, row in result["ways"].items():
        numbers = f"{row['milliseconds']:9.2f}{row['median_milliseconds']:9.2f}{row['times_ours']:9.2f}"
        print(f"{name:24s}{row['clips_per_second']:9d}{numbers}{row['bytes_per_frame']:13d}", flush=True)


def clip_rows(first: np.ndarray) -> np.ndarray:
    """Rows of the frames of each clip, [128, 4]."""
    return first[:, None] + np.arange(FRAMES) * SKIP


def clip_numbers(first: np.ndarray) -> np.ndarray:
    """Numbers of the clips that begin at these rows; all episodes have the same length."""
    return first // LENGTH * (LENGTH - SPAN + 1) + first % LENGTH


def wanted(name: str, only: list[str] | None) -> bool:
    """Whether a format was requested; raw frames always are, for comparison."""
    return name == "raw" or not only or any(name.startswith(start) for start in only)


def size_of(folder: Path, pattern: str) -> int:
    """Bytes of the files, and of the files of the folders, that match a pattern."""
    found = [file for match in folder.glob(pattern) for file in (match.rglob("*") if match.is_dir() else [match])]
    return sum(file.stat().st_size for file in found if file.is_file())


if __name__ == "__main__":
    main()
