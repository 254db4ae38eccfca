"""Layout of a dataset directory, and reading and writing of its header and index.

::

    <dataset>/
      meta.json          written once, atomically: format version, row shapes, target, the user's own fields
      episodes.jsonl     the index: one line per *committed* episode
      pixels.memmap      raw little-endian rows, episode after episode, nothing between them
      action.memmap
      state.memmap

With compressed frames two files replace ``pixels.memmap``::

      pixels.blob        one lossless image per row, one after another
      pixels.offsets     int64 per row: one past the last byte of its image

The index alone defines the episodes of a dataset. Bytes of a data file beyond the rows of the last index line belong
to an episode that was not committed, and a last line without its newline was not committed either: readers ignore
both, a writer truncates them. Any other mismatch is damage and raises an error.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrl_ficreg._utils import MOST_JSON_BYTES, read_bytes, require_regular_file, write_atomic
from torchrl_ficreg.data.frames import frame_bytes, FRAME_FORMATS, FrameFormat
from torchrl_ficreg.keys import ACTION, PIXELS, STATE

FORMAT = "torchrl_ficreg.episodes"
# Version 2 has compressed frames. Raw datasets stay at version 1, so that older code can read them.
VERSIONS = (1, 2)
_MOST = 2**40  # above any number of rows, episodes or bytes of a row; products of two fit into 63 or 64 bits
META_FILE = "meta.json"
INDEX_FILE = "episodes.jsonl"
DTYPES = {PIXELS: np.dtype("<u1"), ACTION: np.dtype("<f4"), STATE: np.dtype("<f8")}

BLOB, OFFSETS = "pixels.blob", "pixels.offsets"
OFFSET_DTYPE = np.dtype("<i8")

COLLECT_HINT = "record it with collect_episodes() or `python sota-implementations/ficreg/collect.py env={env}`"


@dataclass(frozen=True)
class Header:
    """The content of ``meta.json``.

    Attributes:
        target_episodes: number of episodes that makes the dataset complete.
        shapes: key -> shape of one row, for example ``{"pixels": (3, 224, 224), "action": (2,), "state": (4,)}``.
        meta: the user's own fields, as they come back from JSON.
        frames: how the frames are stored.
    """

    target_episodes: int
    shapes: dict[str, tuple[int, ...]]
    meta: dict[str, Any]
    frames: FrameFormat = "raw"

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the data files."""
        pixels = (f"{PIXELS}.memmap",) if self.frames == "raw" else (BLOB, OFFSETS)
        return (*pixels, *(f"{key}.memmap" for key in self.mapped if key != PIXELS))

    @property
    def mapped(self) -> tuple[str, ...]:
        """Keys whose rows lie in a file as they are."""
        return tuple(key for key in DTYPES if key != PIXELS or self.frames == "raw")

    def row_bytes(self, key: str) -> int:
        """Bytes of one row of ``key``."""
        return DTYPES[key].itemsize * prod(self.shapes[key])

    @property
    def shapes_crc(self) -> int:
        """crc32 of the row shapes: rows of one size can have several shapes, which no other checksum distinguishes."""
        return zlib.crc32(json.dumps({key: list(self.shapes[key]) for key in DTYPES}).encode())

    def with_target(self, target_episodes: int) -> Header:
        """The same header with another target."""
        return replace(self, target_episodes=target_episodes)

    def to_json(self) -> str:
        """The text of ``meta.json``."""
        content = {
            "format": FORMAT,
            "version": 1 if self.frames == "raw" else 2,
            "frames": self.frames,
            "target_episodes": self.target_episodes,
            "shapes": {key: list(shape) for key, shape in self.shapes.items()},
            "dtypes": {key: dtype.str for key, dtype in DTYPES.items()},
            "shapes_crc": self.shapes_crc,
            "meta": self.meta,
        }
        return json.dumps(content, indent=2, sort_keys=True) + "\n"

    @classmethod
    def from_json(cls, text: str | bytes, where: str | Path) -> Header:
        """Reads ``meta.json``.

        Args:
            text (str or bytes): its content.
            where (str or Path): its path, for errors.

        Raises:
            ValueError: no JSON, not this format, another version, or a field that is missing or cannot be.
        """
        try:
            content = json.loads(text if isinstance(text, str) else text.decode("utf-8"))
            if content["format"] != FORMAT:
                raise KeyError(FORMAT)
            version = content["version"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{where} is not the header of a {FORMAT} dataset: collect or copy it again.") from error
        if not _is_count(version) or version not in VERSIONS:
            raise ValueError(f"{where} has format version {version!r}, this code reads 1 and 2: collect it again.")
        frames = content.get("frames", "raw")  # absent from the first datasets
        shapes, target = content.get("shapes"), content.get("target_episodes")
        checks = {
            "frames": isinstance(frames, str) and frames in FRAME_FORMATS and (version == 1) == (frames == "raw"),
            "shapes": isinstance(shapes, dict) and all(_is_shape(key, shapes.get(key)) for key in DTYPES),
            "dtypes": content.get("dtypes") == {key: dtype.str for key, dtype in DTYPES.items()},
            "target_episodes": _is_count(target),
            "meta": isinstance(content.get("meta"), dict),
        }
        for name, good in checks.items():
            if not good:
                got = repr(content[name])[:120] if name in content else "nothing"
                raise ValueError(f"{where} has a missing or invalid field {name!r}, {got}: collect or copy it again.")
        header = cls(target, {key: tuple(shapes[key]) for key in DTYPES}, content["meta"], frames)
        if content.get("shapes_crc", header.shapes_crc) != header.shapes_crc:  # absent from older datasets
            raise ValueError(f"{where}: the row shapes {shapes} do not match their checksum: collect or copy it again.")
        return header


def read_header(path: Path) -> Header:
    """The header of the dataset in a folder.

    Raises:
        FileNotFoundError: there is none.
        ValueError: see :meth:`Header.from_json`.
    """
    return Header.from_json(read_bytes(path / META_FILE, most=MOST_JSON_BYTES), path / META_FILE)


def read_index(path: Path, header: Header) -> tuple[list[IndexEntry], int]:
    """As :func:`parse_index` of the dataset in a folder, whose header has been read.

    Raises:
        ValueError: the index is damaged, or holds more episodes than the header's target.
    """
    entries, committed = parse_index(read_bytes(path / INDEX_FILE), path / INDEX_FILE)
    if len(entries) > header.target_episodes:
        raise ValueError(
            f"{path / INDEX_FILE} holds {len(entries)} episodes, {META_FILE} a target of {header.target_episodes}: one "
            "of the two is damaged, restore it."
        )
    return entries, committed


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value < _MOST


def _is_shape(key: str, shape: Any) -> bool:
    """Whether rows of ``key`` may have this shape: [3, H, W] pixels, [A] actions, [S] states, of which S may be 0."""
    if key == STATE and shape == [0]:
        return True
    if not isinstance(shape, list) or not all(_is_count(size) for size in shape) or prod(shape) >= _MOST:
        return False
    return len(shape) == 3 and shape[0] == 3 if key == PIXELS else len(shape) == 1


class IndexEntry(NamedTuple):
    """One line of ``episodes.jsonl``: a committed episode.

    Attributes:
        episode: id, from 1 and without gaps.
        start: its first row in every data file.
        length: its number of rows.
        crc: crc32 of its action bytes followed by its state bytes.
        pixels_crc: crc32 of its pixel bytes, before any compression.
    """

    episode: int
    start: int
    length: int
    crc: int
    pixels_crc: int

    @property
    def stop(self) -> int:
        """One past its last row."""
        return self.start + self.length

    def to_line(self) -> bytes:
        """The line with its newline, without which it does not count."""
        return json.dumps(self._asdict()).encode() + b"\n"


def parse_index(content: bytes, where: str | Path) -> tuple[list[IndexEntry], int]:
    """Reads the index and drops a torn last line.

    Args:
        content (bytes): of ``episodes.jsonl``.
        where (str or Path): its path, for errors.

    Returns:
        The committed episodes, and the number of leading bytes of ``content`` that they occupy.

    Raises:
        ValueError: a whole line is invalid, or does not continue the one before it.

    Examples:
        >>> first = IndexEntry(1, 0, 21, 7, 8)
        >>> entries, committed = parse_index(first.to_line() + b'{"episode": 2, "sta', "episodes.jsonl")
        >>> entries == [first], committed == len(first.to_line())
        (True, True)
    """
    committed = content.rfind(b"\n") + 1
    entries: list[IndexEntry] = []
    for number, line in enumerate(content[:committed].splitlines(), start=1):
        try:
            entry = IndexEntry(**json.loads(line))
            whole = all(isinstance(value, int) and not isinstance(value, bool) for value in entry)
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{where}, line {number} is invalid: restore the file or collect again.") from error
        expected = (number, entries[-1].stop if entries else 0)
        whole = whole and all(0 <= crc < 2**32 for crc in (entry.crc, entry.pixels_crc))
        if not whole or (entry.episode, entry.start) != expected or not 1 <= entry.length < _MOST - entry.start:
            got = f"episode {entry.episode} at row {entry.start} with {entry.length} rows"
            want = f"episode {expected[0]} at row {expected[1]}"
            raise ValueError(f"{where}, line {number} holds {got}, expected {want}: restore it or collect again.")
        entries.append(entry)
    return entries, committed


def checksums(episode: dict[str, np.ndarray]) -> tuple[int, int]:
    """crc32 of (action then state) and of the pixels of one episode, as stored.

    Examples:
        >>> zero = {"pixels": np.zeros((2, 3, 4, 4), "u1"), "action": np.zeros((2, 2), "f4"), "state": np.zeros((2, 1))}
        >>> checksums(zero) == (zlib.crc32(bytes(2 * 2 * 4 + 2 * 8)), zlib.crc32(bytes(2 * 3 * 16)))
        True
    """
    action, state, pixels = (np.ascontiguousarray(episode[key], DTYPES[key]) for key in (ACTION, STATE, PIXELS))
    return zlib.crc32(state, zlib.crc32(action)), zlib.crc32(pixels)


def data_file(path: Path, key: str) -> Path:
    """The file that holds the rows of ``key`` as they are."""
    return path / f"{key}.memmap"


def check_sizes(path: Path, header: Header, num_steps: int) -> None:
    """Checks that every data file is long enough for the rows of the index.

    Raises:
        ValueError: a data file is missing or too short.
    """
    for key in header.mapped:
        _check_size(data_file(path, key), num_steps * header.row_bytes(key))
    if header.frames != "raw":
        ends = read_offsets(path, num_steps)
        _check_size(path / BLOB, int(ends[-1]) if num_steps else 0)


def read_offsets(path: Path, num_steps: int) -> np.ndarray:
    """The end of each row's image, int64 [num_steps], in bytes of ``pixels.blob``.

    Raises:
        ValueError: the file is missing, too short, or its numbers do not increase.
    """
    _check_size(path / OFFSETS, num_steps * OFFSET_DTYPE.itemsize)
    ends = np.fromfile(path / OFFSETS, OFFSET_DTYPE, count=num_steps)
    if (np.diff(ends, prepend=0) <= 0).any():
        row = int(np.argmax(np.diff(ends, prepend=0) <= 0))
        raise ValueError(
            f"{path / OFFSETS} is damaged: the image of row {row} ends where it begins or before: restore it or "
            "collect again."
        )
    return ends


def _check_size(file: Path, need: int) -> None:
    exists = file.exists()
    size = require_regular_file(file).st_size if exists else 0
    if size < need or not exists:
        raise ValueError(f"{file} is damaged: {size} bytes, the index needs {need}: restore it or collect again.")


def estimate_bytes(
    num_steps: int,
    image_size: int | tuple[int, int],
    action_dim: int,
    state_dim: int,
    frames: FrameFormat = "raw",
) -> int:
    """Disk space of ``num_steps`` rows, in bytes: exact for raw frames, an upper estimate for compressed ones.

    Args:
        num_steps (int): rows over all episodes.
        image_size (int or tuple of int): pixels of a side, or (height, width).
        action_dim (int): A.
        state_dim (int): S.
        frames (str, optional): how the frames are stored. The estimate of compressed ones holds for drawings and simple
            renderings, such as those of the environments of this package; photographs need more. Default: ``"raw"``.

    Examples:
        >>> estimate_bytes(10_000, 64, action_dim=2, state_dim=4)  # 123 MB
        123280000
        >>> estimate_bytes(10_000, 64, action_dim=2, state_dim=4, frames="webp")
        38880000
    """
    height, width = (image_size, image_size) if isinstance(image_size, int) else image_size
    row = DTYPES[ACTION].itemsize * action_dim + DTYPES[STATE].itemsize * state_dim
    return num_steps * (row + frame_bytes(height, width, frames))


def write_header(path: Path, header: Header) -> None:
    """Writes ``meta.json`` atomically: a crash leaves the old file or the new one."""
    write_atomic(path / META_FILE, header.to_json())
    sync_directory(path)


def sync_directory(path: Path) -> None:
    """Makes the names in a directory durable, as ``fsync`` of a file does for its bytes."""
    if not hasattr(os, "O_DIRECTORY"):  # Windows opens no folders
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:  # CIFS, FUSE and others do not support it
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS):
            raise
    finally:
        os.close(descriptor)


def check_episode(episode: dict[str, np.ndarray]) -> int:
    """Checks one recorded episode against the key contract.

    Args:
        episode (dict): arrays ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S] float64
            (S = 0 without a simulator). Row t holds a frame, the action taken there, and the state it was drawn from.

    Returns:
        L, the number of steps.

    Raises:
        KeyError: a key is missing or unknown.
        TypeError: a value is not a numpy array.
        ValueError: a shape (an empty one too), a dtype, a non-finite value, or an action at the last step.
    """
    expected = {PIXELS: (4, np.uint8), ACTION: (2, np.float32), STATE: (2, np.float64)}
    if set(episode) != set(expected):
        missing, surplus = sorted(set(expected) - set(episode)), sorted(set(episode) - set(expected))
        raise KeyError(f"an episode holds exactly {sorted(expected)}: missing {missing}, not wanted {surplus}.")
    for key, value in episode.items():
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{key!r} must be a numpy array, got a {type(value).__name__}: convert it before writing.")
    lengths = {key: len(value) for key, value in episode.items()}
    if len(set(lengths.values())) != 1 or min(lengths.values()) < 2:
        raise ValueError(f"an episode needs at least 2 steps, equally many of each key, got {lengths}.")
    for key, (ndim, dtype) in expected.items():
        value = episode[key]
        if value.ndim != ndim or value.dtype != dtype:
            want = f"{ndim}-d {np.dtype(dtype).name}"
            raise ValueError(f"{key!r} must be {want}, got {value.ndim}-d {value.dtype}: convert it before writing.")
        if not value.size and (key != STATE or value.shape[1:] != (0,)):  # only the state may be empty
            raise ValueError(f"{key!r} must hold at least one number per step, got shape {value.shape}.")
        if key != PIXELS and not np.isfinite(value).all():
            raise ValueError(f"{key!r} holds a NaN or an infinity: drop those steps before writing.")
    if episode[PIXELS].shape[1] != 3:
        raise ValueError(f"'pixels' must be [L, 3, H, W], got {episode[PIXELS].shape}: move the channel axis first.")
    if np.any(episode[ACTION][-1]):
        raise ValueError("the last step leads nowhere: its action must be zero, or the actions are shifted by one.")
    return len(episode[PIXELS])
