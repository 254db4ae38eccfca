"""Crash-safe, append-only recording of episodes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg._utils import BINARY, lock_file, NO_FOLLOW, read_bytes, require_regular_file, write_all
from torchrl_ficreg.data.frames import check_frame_format, encode_frames, FrameFormat
from torchrl_ficreg.data.layout import (
    BLOB,
    check_episode,
    checksums,
    DTYPES,
    Header,
    INDEX_FILE,
    IndexEntry,
    META_FILE,
    OFFSET_DTYPE,
    OFFSETS,
    read_header,
    read_index,
    read_offsets,
    sync_directory,
    write_header,
)
from torchrl_ficreg.data.store import EpisodeStore
from torchrl_ficreg.keys import PIXELS


class EpisodeWriter:
    """Appends episodes to a dataset directory, safe against being killed at any instant.

    An episode is *committed* by the end of its index line, which is written after its rows are on disk::

        index line without its end -> fsync -> rows -> pixels, action, state files -> fsync -> end of the line -> fsync

    A crash therefore loses at most the episode being appended. Opening the directory again truncates every file to the
    last committed episode, and :attr:`num_episodes` is where to continue: a collection that derives episode k from
    ``(seed, k)`` can be run again and never repeats or skips one. An episode whose rows are complete and whose index
    line is a beginning of the right one is committed instead.

    Files are truncated only after the checksums of committed episodes were compared, and by no more than one unfinished
    episode. A complete dataset is not opened for writing at all, so it may lie on a read-only file system.

    Args:
        path (str or Path): directory of the dataset, created when missing.

    Keyword Args:
        target_episodes (int): number of episodes at which the dataset is complete.
        meta (dict): everything that reproduces the data (environment, its arguments, image size, seed, expert, action
            bounds): values of JSON, numpy values included.
        resume (bool, optional): continue an existing dataset. With ``False`` an existing dataset is an error.
            Default: ``True``.
        wait (bool, optional): wait until another writer of the same dataset has finished. With ``False`` another writer
            is an error. Default: ``False``.
        frames (str, optional): ``"raw"`` is fastest to read. ``"webp"`` and ``"png"`` store one lossless image per frame,
            with the same frames and the same fingerprint. Default: ``"raw"``.
        num_threads (int, optional): frames compressed at a time. Default: the usable cores, at most eight.

    Raises:
        FileExistsError: the dataset exists and ``resume`` is false.
        ImportError: ``frames`` needs Pillow.
        RuntimeError: another writer has the dataset open.
        TypeError: ``meta`` holds something JSON cannot.
        ValueError: the dataset was begun with another ``meta``, other ``frames`` or a larger target, or is damaged;
            its files are left as they are.

    Examples:
        >>> import tempfile, numpy as np
        >>> steps = 30
        >>> episode = {
        ...     "pixels": np.zeros((steps, 3, 8, 8), dtype=np.uint8),
        ...     "action": np.zeros((steps, 2), dtype=np.float32),
        ...     "state": np.zeros((steps, 4), dtype=np.float64),
        ... }
        >>> with tempfile.TemporaryDirectory() as path:
        ...     with EpisodeWriter(path, target_episodes=2, meta={"env": "two_room", "seed": 0}) as writer:
        ...         _ = writer.append(episode)
        ...     with EpisodeWriter(path, target_episodes=2, meta={"env": "two_room", "seed": 0}) as writer:
        ...         for number in range(writer.num_episodes, writer.target_episodes):
        ...             _ = writer.append(episode)
        ...         writer.finish()
        ...     writer.num_episodes, writer.num_steps, writer.complete
        (2, 60, True)
    """

    def __init__(
        self,
        path: str | Path,
        *,
        target_episodes: int,
        meta: Mapping[str, Any],
        resume: bool = True,
        wait: bool = False,
        frames: FrameFormat = "raw",
        num_threads: int | None = None,
    ) -> None:
        check_frame_format(frames)
        if target_episodes < 1:
            raise ValueError(f"target_episodes must be at least 1, got {target_episodes}.")
        self.path = Path(path).expanduser()
        self.target_episodes = int(target_episodes)
        self.meta: dict[str, Any] = json.loads(json.dumps(dict(meta), default=_to_builtin))
        self.frames: FrameFormat = frames
        self.num_threads = num_threads
        self.num_episodes = 0
        self.num_steps = 0
        self._header: Header | None = None
        self._index_bytes = 0
        self._blob_bytes = 0
        self._files: dict[str, int] = {}
        if not resume and (self.path / META_FILE).exists():
            raise FileExistsError(f"{self.path} already holds a dataset: pass resume=True, or another directory.")
        self._index = -1
        if (self.path / META_FILE).exists():  # looked for before anything is created, let alone cut
            header, entries = self._read()
            if len(entries) >= self.target_episodes == header.target_episodes:
                self._verified(header, entries)
                return
        self.path.mkdir(parents=True, exist_ok=True)
        self._index = self._open(INDEX_FILE)
        try:
            try:
                lock_file(self._index, self.path, wait=wait)
            except BlockingIOError as error:
                raise RuntimeError(f"another writer has {self.path} open: wait for it or use another path.") from error
            for part in self.path.glob(f"{META_FILE}.*.part"):  # of a writer that was killed
                part.unlink()
            if (self.path / META_FILE).exists():
                self._resume()
            elif os.fstat(self._index).st_size:
                raise ValueError(f"{self.path} has an index but no {META_FILE}: restore it, or use another directory.")
        except BaseException:
            self.close()
            raise

    @property
    def complete(self) -> bool:
        """Whether the target has been reached."""
        return self.num_episodes >= self.target_episodes

    def append(self, episode: dict[str, np.ndarray]) -> int:
        """Writes and commits one episode.

        Args:
            episode (dict): see :func:`~torchrl_ficreg.data.layout.check_episode`; row shapes as in the first episode.

        Returns:
            The id of the episode, from 1.

        Raises:
            KeyError, ValueError: the episode breaks the key contract or has other row shapes than the first.
            OSError: the disk is full or fails. The dataset still holds every episode committed before.
            RuntimeError: the writer is closed, or the target has been reached.
        """
        if self.complete:
            raise RuntimeError(f"{self.path} holds its {self.target_episodes} episodes: open it with a larger target.")
        if self._index < 0:
            raise RuntimeError(f"the writer of {self.path} is closed: open a new one to continue.")
        length = check_episode(episode)
        shapes = {key: tuple(episode[key].shape[1:]) for key in DTYPES}
        if self._header is None:
            self._begin(shapes)
        elif shapes != self._header.shapes:
            raise ValueError(f"row shapes must stay {self._header.shapes}, got {shapes}: use another directory.")
        entry = IndexEntry(self.num_episodes + 1, self.num_steps, length, *checksums(episode))
        line, (content, blob_bytes) = entry.to_line(), self._to_files(episode)
        try:
            write_all(self._index, line.removesuffix(b"\n"))  # from it the next opening knows how much a crash may have left
            os.fsync(self._index)
            for name, rows in content.items():
                write_all(self._files[name], rows)
            for descriptor in self._files.values():
                os.fsync(descriptor)
            write_all(self._index, b"\n")
            os.fsync(self._index)
        except BaseException as error:
            # Truncating needs no space, so it also works on a full disk. If it fails, the next opening does it.
            self._truncate()
            if isinstance(error, OSError) and error.filename is None:
                raise OSError(
                    error.errno,
                    f"{error.strerror}: episode {entry.episode} cannot be written, those before it are whole; make room and "
                    "run the same command again",
                    str(self.path),
                ) from error
            raise
        self.num_episodes, self.num_steps = entry.episode, entry.stop
        self._index_bytes += len(line)
        self._blob_bytes = blob_bytes
        return entry.episode

    def finish(self) -> None:
        """Closes the writer and checks that the dataset is complete.

        Raises:
            RuntimeError: fewer episodes than the target were committed.
        """
        self.close()
        if not self.complete:
            got = f"{self.num_episodes} of {self.target_episodes} episodes"
            raise RuntimeError(f"{self.path} holds {got}: append the rest before finish(), or leave with close().")

    def close(self) -> None:
        """Releases the files and the lock. Appended episodes are already on disk. Idempotent."""
        descriptors = [*self._files.values(), *([self._index] if self._index >= 0 else [])]
        self._files, self._index = {}, -1
        for descriptor in descriptors:
            os.close(descriptor)

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _to_files(self, episode: dict[str, np.ndarray]) -> tuple[dict[str, Any], int]:
        """The bytes to append to each data file, and the resulting size of the file of images."""
        content: dict[str, Any] = {
            f"{key}.memmap": np.ascontiguousarray(episode[key], dtype)
            for key, dtype in DTYPES.items()
            if key in self._header.mapped
        }
        if self.frames == "raw":
            return content, 0
        images = encode_frames(episode[PIXELS], self.frames, num_threads=self.num_threads)
        ends = self._blob_bytes + np.cumsum([len(image) for image in images])
        return {BLOB: b"".join(images), OFFSETS: ends.astype(OFFSET_DTYPE), **content}, int(ends[-1])

    def _begin(self, shapes: dict[str, tuple[int, ...]]) -> None:
        # meta.json is written last: a directory with one has all its files.
        header = Header(self.target_episodes, shapes, self.meta, self.frames)
        self._open_data(header)
        self._truncate()
        write_header(self.path, header)
        self._header = header

    def _read(self) -> tuple[Header, list[IndexEntry]]:
        """Header and index of the existing dataset, compared with the arguments; nothing is opened for writing."""
        header = read_header(self.path)
        lost = [name for name in (INDEX_FILE, *header.files) if not os.path.lexists(self.path / name)]
        if lost:
            raise ValueError(f"{self.path} has lost {', '.join(lost)}: restore it, or use another directory.")
        self._check_meta(header)
        entries, self._index_bytes = read_index(self.path, header)
        if entries:
            self.num_episodes, self.num_steps = entries[-1].episode, entries[-1].stop
        return header, entries

    def _verified(self, header: Header, entries: list[IndexEntry]) -> EpisodeStore:
        """The committed episodes, after the checksums of the first and the last were compared."""
        store = EpisodeStore(header, entries, None, self.path, num_threads=self.num_threads)
        for entry in {entries[0], entries[-1]}:
            store.check_episode(entry)
        return store

    def _resume(self) -> None:
        header, entries = self._read()  # again, under the lock
        if entries:
            store = self._verified(header, entries)
            if header.frames != "raw":
                self._blob_bytes = store.blob_bytes
        self._header = header
        if (last := self._episode_of_torn_line(entries)) is not None:
            write_all(self._index, last.to_line()[os.fstat(self._index).st_size - self._index_bytes :])
            os.fsync(self._index)
            entries, self.num_episodes, self.num_steps = [*entries, last], last.episode, last.stop
            self._index_bytes += len(last.to_line())
            if header.frames != "raw":
                self._blob_bytes = int(read_offsets(self.path, last.stop)[-1])
        self._check_excess(entries)
        self._open_data(header)
        self._truncate()
        if self.target_episodes != header.target_episodes:
            self._header = header.with_target(self.target_episodes)
            write_header(self.path, self._header)

    def _check_excess(self, entries: list[IndexEntry]) -> None:
        """Refuses to truncate more than one unfinished episode: then the header or the index is damaged, not the data.

        Raises:
            ValueError: a file holds more behind the last committed episode.
        """
        if not entries and min(self._rows_behind()) < 2:  # not even one episode is whole
            return
        most = self._unfinished_rows(entries)
        image = self._header.row_bytes(PIXELS) + 1024  # a lossless image is hardly larger than its raw frame
        for name, committed in self._sizes().items():
            row = image if name == BLOB else self._row_bytes(name)
            excess = (self.path / name).stat().st_size - committed
            if excess > most * row:
                raise ValueError(
                    f"{self.path / name} holds {excess} bytes that no committed episode owns, more than one unfinished "
                    f"episode: {META_FILE} or {INDEX_FILE} is damaged. Nothing was changed: restore them."
                )

    def _episode_of_torn_line(self, entries: list[IndexEntry]) -> IndexEntry | None:
        """The episode after the committed ones, if all its rows and a part of its index line are there.

        A crash leaves a whole line before the first row: a torn line with all rows is damage, which the rows can repair.

        Raises:
            ValueError: the torn line does not belong to the rows.
        """
        torn, behind = read_bytes(self.path / INDEX_FILE)[self._index_bytes :], self._rows_behind()
        rows = int(min(behind))
        if not torn or behind != {rows} or rows < 2 or self.num_episodes >= self._header.target_episodes:
            return None
        entry = IndexEntry(self.num_episodes + 1, self.num_steps, rows, 0, 0)
        try:
            store = EpisodeStore(self._header, [*entries, entry], None, self.path, num_threads=self.num_threads)
            crc, pixels_crc = checksums(store.stored(entry))
        except ValueError:  # images that cannot be decoded
            return None
        line = entry._replace(crc=crc, pixels_crc=pixels_crc).to_line()
        if line.startswith(torn):
            return entry._replace(crc=crc, pixels_crc=pixels_crc)
        if not torn.endswith(b"}"):
            raise ValueError(
                f"{self.path / INDEX_FILE} ends in a torn line that does not fit the {rows} rows of its episode: restore the "
                "file, or delete that line to record the episode again. Nothing was changed."
            )
        return None

    def _rows_behind(self) -> set[float]:
        """The number of rows behind the last committed episode, of each data file."""
        sizes = {name: committed for name, committed in self._sizes().items() if name != BLOB and self._row_bytes(name)}
        return {((self.path / name).stat().st_size - sizes[name]) / self._row_bytes(name) for name in sizes}

    def _row_bytes(self, name: str) -> int:
        return OFFSET_DTYPE.itemsize if name == OFFSETS else self._header.row_bytes(name.split(".")[0])

    def _unfinished_rows(self, entries: list[IndexEntry]) -> int:
        """The largest number of rows that one unfinished episode can have left."""
        begun = read_bytes(self.path / INDEX_FILE)[self._index_bytes :]
        try:
            return int(json.loads(begun)["length"])
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError):  # none, or one torn by a power cut
            steps = self._header.meta.get("max_steps")
            longest = max((entry.length for entry in entries), default=0)
            return max(longest, steps + 1 if isinstance(steps, int) else 0)

    def _check_meta(self, header: Header) -> None:
        settings = [("frames", header.frames, self.frames)]
        for name in sorted(set(header.meta) | set(self.meta)):
            both = (header.meta, self.meta)
            old, new = (json.dumps(meta[name], sort_keys=True) if name in meta else "nothing" for meta in both)
            settings.append((name, old, new))
        for name, old, new in settings:
            if old != new:
                raise ValueError(
                    f"{self.path} was begun with {name} = {old}, got {new}: repeat the first settings, or use another "
                    "directory."
                )
        if self.target_episodes < header.target_episodes:
            raise ValueError(
                f"{self.path} was begun with target_episodes = {header.target_episodes}, got {self.target_episodes}: "
                "a target may only grow."
            )

    def _open_data(self, header: Header) -> None:
        for name in set(header.files) - self._files.keys():
            self._files[name] = self._open(name)
        sync_directory(self.path)

    def _open(self, name: str) -> int:
        """Opens a file of the dataset for writing, made if missing; never through a link."""
        path = self.path / name
        if os.path.lexists(path):
            require_regular_file(path, links=False)
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | NO_FOLLOW | BINARY, 0o644)

    def _sizes(self) -> dict[str, int]:
        """Bytes of each data file that belong to committed episodes."""
        rows = {f"{key}.memmap": self.num_steps * self._header.row_bytes(key) for key in self._header.mapped}
        if self.frames == "raw":
            return rows
        return {BLOB: self._blob_bytes, OFFSETS: self.num_steps * OFFSET_DTYPE.itemsize, **rows}

    def _truncate(self) -> None:
        """Truncates the data, then the index, to the last committed episode.

        The unfinished line of the index says how many rows a crash left, so it is removed last; its newline, if it has
        one already, is removed first.
        """
        end = os.fstat(self._index).st_size
        if end > self._index_bytes:
            os.lseek(self._index, end - 1, os.SEEK_SET)  # writes go to the end all the same
            if os.read(self._index, 1) == b"\n":
                os.ftruncate(self._index, end - 1)
        sizes = self._sizes() if self._header else {}
        for name, descriptor in self._files.items():
            os.ftruncate(descriptor, sizes.get(name, 0))
        os.ftruncate(self._index, self._index_bytes)


def _to_builtin(value: Any) -> Any:
    """Numpy arrays, numpy scalars and paths as values of JSON."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"meta must hold what JSON can, got a {type(value).__name__}: convert it first.")
