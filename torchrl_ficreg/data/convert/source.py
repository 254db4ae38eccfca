"""Episodes of a foreign file, one at a time, as our writer takes them."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.images import is_channels_last, resize, to_frames
from torchrl_ficreg.data.convert.table import Table
from torchrl_ficreg.data.convert.tasks import OTHER_ACTIONS, OTHER_PIXELS, OTHER_STATES, TASKS
from torchrl_ficreg.data.schema import ACTION, PIXELS, STATE

# What the readers raise for bytes that are not what they should be.
_DAMAGE = (OSError, EOFError, RuntimeError, ValueError, zlib.error, zipfile.BadZipFile)

# Frames read and scaled at once. Long episodes at 224 pixels would otherwise need their size several times over.
_BLOCK_ROWS = 200


class EpisodeSource:
    """Reads episodes from a table lazily: nothing but the episode asked for is in memory.

    Actions are put where our format has them, row t holding the one that leads to row t + 1. The last row leads
    nowhere: whatever the file has there, a NaN or the action of a step that was not recorded, becomes zero.

    Args:
        table: the opened file.

    Keyword Args:
        env: one of ``two_room``, ``push_t``, ``reacher``, ``cube``: says which columns hold the state, and is noted
            in the dataset. Any other name is only noted.
        state: columns that make the state, joined in this order. Default: the environment's, or what other data
            usually call it.
        pixels: the column of frames. Default ``pixels``, or what other data usually call it.
        action: the column of actions.
        shift: rows by which the actions are moved: ``-1`` where the file keeps an action in the row it leads to,
            ``1`` where it runs one row ahead. ``1`` costs the first row of each episode.
        allow_incomplete: leave out the episodes that an interrupted recording did not finish.

    Attributes:
        lengths: int64 [E], rows of each episode as served. Episodes of fewer than two rows are left out.
        skipped: how many were left out.
        columns: key -> the names of the columns it is made of.

    Raises:
        KeyError: a column is missing.
        ValueError: a column has another shape than its role asks for, or the recording is incomplete.
    """

    def __init__(
        self,
        table: Table,
        *,
        env: str | None = None,
        state: Sequence[str] | None = None,
        pixels: str | None = None,
        action: str | None = None,
        shift: int = 0,
        allow_incomplete: bool = False,
    ) -> None:
        if shift not in (-1, 0, 1):
            raise ValueError(f"shift must be -1, 0 or 1, got {shift}.")
        self.table, self.env, self.shift = table, env, shift
        wanted = TASKS[env].states if env in TASKS else OTHER_STATES
        self.columns: dict[str, list[str]] = {
            PIXELS: self._choose(PIXELS, [(name,) for name in ([pixels] if pixels else self._usual_pixels())]),
            ACTION: self._choose(ACTION, [(name,) for name in ([action] if action else OTHER_ACTIONS)]),
            STATE: self._choose(STATE, [[state] if isinstance(state, str) else state] if state else wanted),
        }
        self.frame_shape = self._frame_shape()
        self.action_dim, self.state_dim = self._width(ACTION), self._width(STATE)
        self._check_task()
        whole = self._count_whole(allow_incomplete)
        lengths = table.lengths[:whole] - max(shift, 0)
        self._kept = np.flatnonzero(lengths >= 2)
        self.lengths = lengths[self._kept]
        self.skipped = whole - len(self._kept)
        if not len(self.lengths):
            raise ValueError(f"{table.path} holds no episode of two rows or more: there is nothing to convert.")

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    def episode(self, index: int, image_size: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
        """Reads one episode.

        Args:
            index: from 0.
            image_size: height and width the frames are scaled to.

        Returns:
            ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S] float64.

        Raises:
            ValueError: the file is damaged there, or holds a NaN or an infinity.
        """
        action, state = self.vectors(index)
        action[-1] = 0
        for key, value in ((ACTION, action), (STATE, state)):
            bad = np.flatnonzero(~np.isfinite(value).all(-1))
            if len(bad):
                raise ValueError(
                    f"{self.table.path}, episode {index}: {' and '.join(self.columns[key])} holds a NaN or an infinity "
                    f"in row {bad[0]} of {len(value)}; only the action of the last row may be missing. If it is the "
                    "first one instead, the actions are stored where they lead to: shift=-1."
                )
        return {PIXELS: self._frames(index, image_size or self.frame_shape), ACTION: action, STATE: state}

    def vectors(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Reads one episode without its frames.

        Args:
            index: from 0.

        Returns:
            action [L, A] float32, the last row as the file has it (NaN where it has none), and state [L, S] float64.
        """
        start, stop = self._rows(index)
        action = self._joined(ACTION, start, stop).astype(np.float32)
        state = self._joined(STATE, start, stop)
        if self.shift:
            action = np.roll(action, self.shift, axis=0)
            action[-1] = np.nan  # -1 takes it away; with 1 it is the action that leads nowhere
        return (action[1:], state[1:]) if self.shift == 1 else (action, state)

    def close(self) -> None:
        """Closes the file."""
        self.table.close()

    def __enter__(self) -> EpisodeSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def facts(self) -> dict[str, Any]:
        """What the dataset notes about where it came from: equal for equal files, whatever folder they are in."""
        numbers = [np.ascontiguousarray(value) for value in self.vectors(0)]
        return {
            "format": self.table.format,
            "file": self.table.path.name,
            "episodes": len(self),
            "rows": int(self.lengths.sum()),
            "columns": self.columns,
            "shift": self.shift,
            "checksum": zlib.crc32(self.lengths, zlib.crc32(numbers[1], zlib.crc32(numbers[0]))),
        }

    def _rows(self, index: int) -> tuple[int, int]:
        episode = self._kept[index]
        start = int(self.table.starts[episode])
        return start, start + int(self.table.lengths[episode])

    def _read(self, name: str, start: int, stop: int) -> np.ndarray:
        try:
            rows = self.table.read(name, start, stop)
            if len(rows) != stop - start:
                raise EOFError(f"got {len(rows)} rows")
        except _DAMAGE as error:
            raise ValueError(
                f"{self.table.path}: rows {start} to {stop} of {name!r} cannot be read ({error}): the file is damaged, "
                "copy it again."
            ) from error
        return rows

    def _joined(self, key: str, start: int, stop: int) -> np.ndarray:
        parts = [self._read(name, start, stop).reshape(stop - start, -1) for name in self.columns[key]]
        return np.concatenate(parts, axis=1, dtype=np.float64)

    def _frames(self, index: int, size: tuple[int, int]) -> np.ndarray:
        start, stop = self._rows(index)
        start += max(self.shift, 0)
        frames = np.empty((stop - start, 3, *size), np.uint8)
        for block in range(start, stop, _BLOCK_ROWS):
            end = min(block + _BLOCK_ROWS, stop)
            images = to_frames(self._read(self.columns[PIXELS][0], block, end))
            if images.shape[2:] != self.frame_shape:
                raise ValueError(
                    f"{self.table.path}: the frames of rows {block} to {end} are {images.shape[2:]}, those of the "
                    f"first row {self.frame_shape}: frames must have one size."
                )
            frames[block - start : end - start] = resize(images, size)
        return frames

    def _usual_pixels(self) -> list[str]:
        cameras = [name for name in self.table.of_kind("image") if name.startswith("observation.images.")]
        return [*OTHER_PIXELS, *(cameras if len(cameras) == 1 else [])]  # of several, the user has to choose

    def _choose(self, key: str, candidates: Sequence[Sequence[str]]) -> list[str]:
        """The first candidate all of whose columns are there, of the right kind."""
        kind = "image" if key == PIXELS else "number"
        for candidate in candidates:
            found = [self.table.find(name) for name in candidate]
            if all(name is not None and self.table.columns[name].kind == kind for name in found):
                return found
        tried = " or ".join(" + ".join(map(repr, candidate)) for candidate in candidates)
        there = self.table.of_kind(kind)
        role = f"{self.env}'s {key}" if self.env and key == STATE else key
        advice = f"name the column by {key}="
        if key == PIXELS and not there:
            advice = "take the variant with images (OGBench: visual-...), or draw frames and use from_arrays()"
        raise KeyError(f"{self.table.path} has no {kind} column for {role}: tried {tried}, got {there}: {advice}.")

    def _count_whole(self, allow_incomplete: bool) -> int:
        """Episodes all of whose rows are there."""
        ends = self.table.starts + self.table.lengths
        present = min(self.table.columns[name].rows for names in self.columns.values() for name in names)
        whole = int((ends <= present).sum())
        if whole < len(ends) and not (allow_incomplete and whole):
            escape = f", or pass allow_incomplete=True to take the {whole} whole episodes" if whole else ""
            raise ValueError(
                f"{self.table.path} is incomplete: its episodes end at row {ends[-1]}, its columns at row {present}: "
                f"copy or record it again{escape}."
            )
        return whole

    def _frame_shape(self) -> tuple[int, int]:
        shape = self.table.columns[self.columns[PIXELS][0]].shape
        return shape[:2] if is_channels_last(shape) else shape[1:]

    def _width(self, key: str) -> int:
        return sum(int(np.prod(self.table.columns[name].shape, dtype=int)) for name in self.columns[key])

    def _check_task(self) -> None:
        if self.env not in TASKS:
            return
        task, got = TASKS[self.env], {ACTION: self.action_dim, STATE: self.state_dim}
        for key, want in ((ACTION, task.action_dim), (STATE, task.state_dim)):
            if got[key] != want:
                names = " + ".join(self.columns[key])
                raise ValueError(
                    f"{self.env} has {want} numbers of {key}, {names} of {self.table.path} has {got[key]}: correct "
                    f"env=, or name the columns by {key}=."
                )
