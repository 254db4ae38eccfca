"""Recorded episodes, opened for reading from a dataset directory or from memory."""

from __future__ import annotations

import hashlib
import mmap
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchrl_ficreg._utils import BINARY, NO_WAIT
from torchrl_ficreg.data.frames import ImageFrames, RawFrames
from torchrl_ficreg.data.layout import (
    BLOB,
    check_episode,
    check_sizes,
    checksums,
    COLLECT_HINT,
    data_file,
    DTYPES,
    Header,
    INDEX_FILE,
    IndexEntry,
    META_FILE,
    read_header,
    read_index,
    read_offsets,
)
from torchrl_ficreg.keys import ACTION, PIXELS, STATE

Verify = Literal["ends", "full", "none"]

# Python has this constant since 3.13. Without the flag Linux refuses a private mapping larger than its memory, because
# every page might be written to; datasets of the size in the paper are several times larger than memory.
_MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000 if sys.platform == "linux" else 0)


class EpisodeStore:
    """All committed episodes of a dataset as flat, episode-contiguous arrays.

    ::

        row      0 1 2 3 4 5 | 6 7 8 9 | 10 ...
        episode  1           | 2       | 3
        start    0             6         10

    The arrays of a directory are private mappings: pages are read when touched, and a write stays in this
    process. A pickled store of a directory contains its path instead of its data, and is mapped again when unpickled.
    Frames of every format are read with :meth:`frames`.

    Args:
        header (Header): target, row shapes and the user's fields.
        entries (list of IndexEntry): the committed episodes.
        arrays (dict or None): key -> [N, ...] rows. ``None`` maps those of ``path``.
        path (Path, optional): the directory the arrays are mapped from. Default: ``None``, data in memory.

    Keyword Args:
        num_threads (int, optional): threads that copy or decode frames; the result does not depend on it. Default: the
            usable cores, at most eight.

    Attributes:
        start: int64 [E], first row of each episode; episode ``e`` is entry ``e - 1``.
        length: int64 [E], rows of each episode.
        arrays: key -> [N, ...] rows; ``pixels`` is among them only when the frames are raw.
        blob_bytes: total size of the images of compressed frames.
        fingerprint: sha256 of the index, and through its checksums of the data; the same for every frame format.
    """

    def __init__(
        self,
        header: Header,
        entries: list[IndexEntry],
        arrays: dict[str, np.ndarray] | None,
        path: Path | None = None,
        *,
        num_threads: int | None = None,
    ) -> None:
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads must be at least 1, got {num_threads}.")
        self.header = header
        self.path = path
        self.num_threads = num_threads
        self.arrays = arrays
        self.start = np.array([entry.start for entry in entries], dtype=np.int64)
        self.length = np.array([entry.length for entry in entries], dtype=np.int64)
        self.fingerprint = hashlib.sha256(b"".join(entry.to_line() for entry in entries)).hexdigest()
        self._open_data()

    @property
    def num_steps(self) -> int:
        """Rows over all episodes."""
        return int(self.length.sum())

    @property
    def num_episodes(self) -> int:
        """Committed episodes."""
        return len(self.length)

    def rows(self, episode: int) -> slice:
        """The rows of an episode (ids begin at 1)."""
        start = int(self.start[episode - 1])
        return slice(start, start + int(self.length[episode - 1]))

    def require_state(self) -> None:
        """Checks that the dataset has states.

        Raises:
            ValueError: the episodes were converted without a state.
        """
        if not self.header.row_bytes(STATE):
            raise ValueError(
                f"{self.path or 'the dataset'} holds no state: training needs none, but start-goal pairs, distances and "
                "clips with the key 'state' do; convert it again with state= naming the columns."
            )

    def frames(self, rows: slice | np.ndarray) -> np.ndarray:
        """Reads frames.

        Args:
            rows (slice or ndarray): rows, or row numbers of any shape.

        Returns:
            uint8 [*rows.shape, 3, H, W], writable. A slice of raw frames is not copied: what is written into it is read
            by later calls in this process, and never reaches the file.

        Raises:
            IndexError: a row beyond the last, or a negative one.
            ValueError: an image is damaged.
        """
        return self._frames.read(rows)

    @classmethod
    def open(
        cls, path: Path, *, allow_incomplete: bool = False, verify: Verify = "ends", num_threads: int | None = None
    ) -> EpisodeStore:
        """Opens a dataset directory.

        Args:
            path (Path): the directory.

        Keyword Args:
            allow_incomplete (bool, optional): accept fewer episodes than the target. Default: ``False``.
            verify (str, optional): which checksums to compare: ``"ends"``, those of the first and last episode,
                ``"full"``, all, or ``"none"``. Default: ``"ends"``.
            num_threads (int, optional): threads that copy or decode frames. Default: the usable cores, at most eight.

        Raises:
            FileNotFoundError: there is no dataset at ``path``.
            ImportError: the frames are compressed and Pillow is missing.
            ValueError: the dataset is damaged, incomplete, empty or of another format version.
        """
        if verify not in ("ends", "full", "none"):
            raise ValueError(f"verify must be 'ends', 'full' or 'none', got {verify!r}.")
        if not (path / META_FILE).exists():
            raise FileNotFoundError(f"no dataset at {path}: {COLLECT_HINT.format(env='<env>')}, or correct the path.")
        header = read_header(path)
        if not (path / INDEX_FILE).exists():
            raise ValueError(f"{path} is damaged: {INDEX_FILE} is missing: restore it or collect again.")
        entries, _ = read_index(path, header)
        if not entries or (len(entries) < header.target_episodes and not allow_incomplete):
            hint = COLLECT_HINT.format(env=header.meta.get("env", "<env>"))
            escape = ", or open it with open_store(path, allow_incomplete=True)" if entries else ""
            got = f"{len(entries)} of {header.target_episodes} episodes"
            raise ValueError(f"{path} holds {got}: {hint}, which continues{escape}.")
        store = cls(header, entries, None, path, num_threads=num_threads)
        checked = {"ends": {entries[0], entries[-1]}, "full": entries, "none": ()}[verify]
        for entry in checked:
            store.check_episode(entry)
        return store

    @classmethod
    def from_episodes(
        cls, episodes: Iterable[Mapping[str, np.ndarray]], *, meta: Mapping[str, Any] | None = None
    ) -> EpisodeStore:
        """Copies episodes into memory, with the checks of :class:`~torchrl_ficreg.data.EpisodeWriter`.

        Args:
            episodes (iterable of dict): see :func:`~torchrl_ficreg.data.layout.check_episode`.

        Keyword Args:
            meta (dict, optional): the user's fields. Default: ``None``, empty.

        Raises:
            KeyError, ValueError: an episode breaks the key contract, the row shapes differ, or there is none.
        """
        episodes = [dict(episode) for episode in episodes]
        if not episodes:
            raise ValueError("a dataset needs at least one episode, got none.")
        entries: list[IndexEntry] = []
        shapes = {key: tuple(episodes[0][key].shape[1:]) for key in DTYPES if key in episodes[0]}
        for number, episode in enumerate(episodes, start=1):
            length = check_episode(episode)
            found = {key: tuple(episode[key].shape[1:]) for key in DTYPES}
            if found != shapes:
                raise ValueError(f"row shapes must be those of the first episode, {shapes}, got {found}.")
            entries.append(IndexEntry(number, entries[-1].stop if entries else 0, length, *checksums(episode)))
        arrays = {key: np.concatenate([episode[key] for episode in episodes]) for key in DTYPES}
        return cls(Header(len(episodes), shapes, dict(meta or {})), entries, arrays)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_frames"]
        if self.path is not None:
            state["arrays"] = None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open_data()

    def _open_data(self) -> None:
        options = {"num_threads": self.num_threads}
        header, num_steps = self.header, self.num_steps
        self._sizes: dict[Path, int] = {}
        if self.path is not None and self.arrays is None:
            check_sizes(self.path, header, num_steps)
            self.arrays = {key: _map_rows(self.path, header, num_steps, key) for key in header.mapped}
            self._sizes = {data_file(self.path, key): num_steps * header.row_bytes(key) for key in header.mapped}
        if header.frames == "raw":
            self._frames: RawFrames | ImageFrames = RawFrames(self.arrays[PIXELS], **options)
        else:
            ends = read_offsets(self.path, num_steps)
            blob = _map_file(self.path / BLOB, int(ends[-1]))
            self.blob_bytes = self._sizes[self.path / BLOB] = int(ends[-1])
            self._frames = ImageFrames(
                blob, ends, header.shapes[PIXELS], header.frames, where=str(self.path), **options
            )

    def check_files(self) -> None:
        """Checks that no mapped file has become shorter: reading beyond its end would kill the process by SIGBUS.

        It takes some microseconds per file. A file that was removed stays readable through its mapping.

        Raises:
            OSError: a file has become shorter.
        """
        for file, need in self._sizes.items():
            try:
                size = os.stat(file).st_size
            except FileNotFoundError:
                continue
            if size < need:
                raise OSError(f"{file} has shrunk from {need} to {size} bytes: restore it and open the dataset again.")

    def stored(self, entry: IndexEntry) -> dict[str, np.ndarray]:
        """The rows of an episode, as they are stored."""
        rows = slice(entry.start, entry.stop)
        return {**{key: array[rows] for key, array in self.arrays.items()}, PIXELS: self.frames(rows)}

    def check_episode(self, entry: IndexEntry) -> None:
        """Compares the checksums of one episode, and checks that its numbers are finite.

        Raises:
            ValueError: they differ, or an action or state is not finite.
        """
        episode = self.stored(entry)
        if checksums(episode) != (entry.crc, entry.pixels_crc):
            raise ValueError(
                f"{self.path} is damaged: the bytes of episode {entry.episode} do not match their checksum: "
                "restore the files or collect again."
            )
        for key in (ACTION, STATE):
            if not np.isfinite(episode[key]).all():
                raise ValueError(
                    f"{self.path} holds a NaN or an infinity in {key!r} of episode {entry.episode}: collect it again."
                )


def _map_rows(path: Path, header: Header, num_steps: int, key: str) -> np.ndarray:
    """Maps the first ``num_steps`` rows of a key."""
    if not header.row_bytes(key):  # an empty state: nothing can be mapped
        return np.empty((num_steps, *header.shapes[key]), DTYPES[key])
    mapped = _map_file(data_file(path, key), num_steps * header.row_bytes(key))
    return np.frombuffer(mapped, DTYPES[key]).reshape(num_steps, *header.shapes[key])


def _map_file(file: Path, size: int) -> mmap.mmap:
    """Maps the first ``size`` bytes of a file, copy-on-write."""
    descriptor = os.open(file, os.O_RDONLY | NO_WAIT | BINARY)
    try:
        if not hasattr(mmap, "MAP_PRIVATE"):  # Windows
            return mmap.mmap(descriptor, size, access=mmap.ACCESS_COPY)
        flags, protection = mmap.MAP_PRIVATE | _MAP_NORESERVE, mmap.PROT_READ | mmap.PROT_WRITE
        return mmap.mmap(descriptor, size, flags=flags, prot=protection)
    finally:
        os.close(descriptor)
