"""Episodes of a source file, read one at a time in the layout of :class:`~torchrl_ficreg.data.EpisodeWriter`."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.images import is_channels_last, MOST_PIXELS, resize, to_frames
from torchrl_ficreg.data.convert.table import brief, is_foreign, Kind, some, Table
from torchrl_ficreg.keys import ACTION, PIXELS, STATE


# Frames read and scaled at once: a long episode at 224 pixels would otherwise be in memory several times.
_BLOCK_ROWS = 200
_BLOCK_BYTES = 64 * 2**20

# Limits of one episode: a small file can declare more than fits in memory.
_MOST_EPISODE_ROWS = 1_000_000
_MOST_NUMBERS = 64_000_000
_MOST_FRAME_BYTES = 16 * 2**30


class EpisodeSource:
    """Reads episodes from a table lazily: only the requested episode is in memory.

    Row t of an episode holds the action that leads to row t + 1. The action of the last row is always zero: whatever
    the file has there, a NaN or the action of a step that was not recorded, is not used.

    Args:
        table (Table): the opened file.

    Keyword Args:
        env (str, optional): ``"two_room"``, ``"push_t"``, ``"reacher"`` or ``"cube"`` selects the columns of the state;
            any other name is only stored with the dataset. Default: ``None``, unknown.
        state (str or sequence of str, optional): columns that are joined to the state, such as ``["qpos", "qvel"]``.
            Default: those of the environment, or usual names; data of other environments may have none: [L, 0].
        pixels (str, optional): column of the frames. Default: ``"pixels"``, or another usual name.
        action (str, optional): column of the actions. Default: ``"action"`` or ``"actions"``.
        shift (int, optional): rows by which the actions are moved: ``-1`` where the file stores an action in the row it
            leads to, ``1`` where it stores it one row too early, which costs the first row of each episode.
            Default: ``0``.
        allow_incomplete (bool, optional): leave out the episodes that an interrupted recording did not finish.
            Default: ``False``.
        skip_bad_episodes (bool, optional): see :meth:`leave_out_bad_episodes`. Default: ``False``.

    Attributes:
        lengths: int64 [E], rows of each episode that is served. Episodes of fewer than two rows are left out.
        skipped: number of episodes that were left out for their length.
        notices: what else was left out, one sentence each.
        columns: key -> the names of the columns it is made of.

    Raises:
        KeyError: a column is missing.
        ValueError: a column has a shape that does not fit its role, or the recording is incomplete.
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
        skip_bad_episodes: bool = False,
    ) -> None:
        if shift not in (-1, 0, 1):
            raise ValueError(f"shift must be -1, 0 or 1, got {shift}.")
        self.table, self.env, self.shift = table, env, shift
        wanted = TASKS[env].states if env in TASKS else OTHER_STATES
        self.columns: dict[str, list[str]] = {
            PIXELS: self._choose(PIXELS, [(name,) for name in ([pixels] if pixels else self._usual_pixels())]),
            ACTION: self._choose(ACTION, [(name,) for name in ([action] if action else OTHER_ACTIONS)]),
        }
        self.notices = list(table.notices)
        self.columns[STATE] = self._choose_state(state, wanted)
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
        if skip_bad_episodes:
            self.leave_out_bad_episodes()

    def leave_out_bad_episodes(self) -> None:
        """Reads everything once, and leaves out the episodes that cannot be read or hold a NaN or an infinity.

        This happens before the first episode is written: a conversion that is resumed must number the episodes alike.

        Raises:
            ValueError: no episode is left; the message names the error of the first.
        """
        reasons: dict[int, ValueError] = {}
        for index in range(len(self)):
            try:
                self._check_finite(index, *self.vectors(index))
                for _ in self._blocks(index):
                    pass
            except ValueError as error:
                reasons[index] = error
        if not reasons:
            return
        if len(reasons) == len(self):
            raise ValueError(f"all {len(self)} episodes are bad; the first: {brief(reasons[0], 240)}") from reasons[0]
        first = brief(reasons[min(reasons)], 180)
        self.notices.append(f"{len(reasons)} of {len(self)} episodes are bad and left out; the first: {first}")
        good = np.delete(np.arange(len(self)), list(reasons))
        self._kept, self.lengths = self._kept[good], self.lengths[good]

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    def episode(self, index: int, image_size: tuple[int, int] | None = None) -> dict[str, np.ndarray]:
        """Reads one episode.

        Args:
            index (int): from 0.
            image_size (tuple of int, optional): height and width the frames are scaled to. Default: ``None``, as they
                are.

        Returns:
            ``pixels`` [L, 3, H, W] uint8, ``action`` [L, A] float32 and ``state`` [L, S] float64.

        Raises:
            ValueError: the file is damaged there, or holds a NaN or an infinity.
        """
        action, state = self.vectors(index)
        self._check_finite(index, action, state)
        action[-1] = 0
        return {PIXELS: self._frames(index, image_size or self.frame_shape), ACTION: action, STATE: state}

    def vectors(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Reads one episode without its frames.

        Args:
            index (int): from 0.

        Returns:
            action [L, A] float32, with the last row of the file (NaN where it has none), and state [L, S] float64.
        """
        start, stop = self._rows(index)
        with np.errstate(over="ignore"):  # numbers beyond float32 become infinities, which are refused
            action = self._joined(ACTION, start, stop).astype(np.float32)
        state = self._joined(STATE, start, stop)
        if self.shift:
            action = np.roll(action, self.shift, axis=0)
            action[-1] = np.nan  # with -1 there is none, with 1 it leads nowhere
        return (action[1:], state[1:]) if self.shift == 1 else (action, state)

    def close(self) -> None:
        """Closes the file."""
        self.table.close()

    def __enter__(self) -> EpisodeSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def facts(self) -> dict[str, Any]:
        """The origin, as it is stored with the dataset: equal for equal files, in whatever folder they are."""
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
        start, length = int(self.table.starts[episode]), int(self.table.lengths[episode])
        if length > _MOST_EPISODE_ROWS or length * (self.action_dim + self.state_dim) > _MOST_NUMBERS:
            raise ValueError(
                f"{self.table.path}, episode {index} has {length} rows of {self.action_dim + self.state_dim} numbers, more "
                f"than are read at once ({_MOST_EPISODE_ROWS} rows, {_MOST_NUMBERS} numbers): divide it, or correct the "
                "lengths of the episodes."
            )
        return start, start + length

    def _check_finite(self, index: int, action: np.ndarray, state: np.ndarray) -> None:
        for key, value in ((ACTION, action[:-1]), (STATE, state)):
            bad = np.flatnonzero(~np.isfinite(value).all(-1))
            if len(bad):
                first = " Are the actions stored where they lead to? Then shift=-1." if key == ACTION and not bad[0] else ""
                raise ValueError(
                    f"{self.table.path}, episode {index}: {some(self.columns[key], 2)} holds a NaN or an infinity in row "
                    f"{bad[0]} of {len(state)}: correct it, or pass skip_bad_episodes=True to leave such episodes out.{first}"
                )

    def _read(self, name: str, start: int, stop: int) -> np.ndarray:
        try:
            rows = self.table.read(name, start, stop)
            if len(rows) != stop - start:
                raise EOFError(f"got {len(rows)} rows")
        except BaseException as error:
            if not is_foreign(error):
                raise
            raise ValueError(
                f"{self.table.path}: rows {start} to {stop} of {name!r} cannot be read ({brief(error)}): the file is "
                "damaged: copy it again, or pass skip_bad_episodes=True to leave such episodes out."
            ) from error
        return rows

    def _joined(self, key: str, start: int, stop: int) -> np.ndarray:
        if not self.columns[key]:
            return np.empty((stop - start, 0))
        parts = [self._read(name, start, stop).reshape(stop - start, -1) for name in self.columns[key]]
        return np.concatenate(parts, axis=1, dtype=np.float64)

    def _frames(self, index: int, size: tuple[int, int]) -> np.ndarray:
        rows = int(self.lengths[index])
        if rows * 3 * size[0] * size[1] > _MOST_FRAME_BYTES:
            raise ValueError(
                f"{self.table.path}, episode {index} has {rows} frames of {size[0]} x {size[1]}, more than fit in memory: "
                "pass a smaller image_size=, or divide it."
            )
        frames, done = np.empty((rows, 3, *size), np.uint8), 0
        for images in self._blocks(index):
            frames[done : done + len(images)] = resize(images, size)
            done += len(images)
        return frames

    def _blocks(self, index: int) -> Iterator[np.ndarray]:
        """The frames of an episode in blocks [L', 3, H, W] of bounded size."""
        start, stop = self._rows(index)
        start += max(self.shift, 0)
        step = min(max(_BLOCK_BYTES // (3 * self.frame_shape[0] * self.frame_shape[1]), 1), _BLOCK_ROWS)
        for block in range(start, stop, step):
            end = min(block + step, stop)
            images = to_frames(self._read(self.columns[PIXELS][0], block, end))
            if images.shape[2:] != self.frame_shape:
                raise ValueError(
                    f"{self.table.path}: the frames of rows {block} to {end} are {images.shape[2:]}, those of the "
                    f"first row {self.frame_shape}: frames must have one size."
                )
            yield images

    def _usual_pixels(self) -> list[str]:
        cameras = [name for name in self.table.of_kind("image") if name.startswith("observation.images.")]
        cameras = cameras or [name for name in self.table.left_out if name.startswith("observation.images.")][:1]
        return [*OTHER_PIXELS, *(cameras if len(cameras) == 1 else [])]  # of several cameras the user has to choose one

    def _choose_state(self, state: str | Sequence[str] | None, usual: Sequence[Sequence[str]]) -> list[str]:
        """The columns of the state; data of other environments may have none, since no loss reads it."""
        if state is not None and len(state):
            return self._choose(STATE, [[state] if isinstance(state, str) else state])
        try:
            return self._choose(STATE, usual)
        except KeyError:
            if self.env in TASKS:
                raise
            numbers = [name for name in self.table.of_kind("number") if name not in self.columns[ACTION]]
            there = f" (there are {some(numbers, 4)}: name them by state= to keep them)" if numbers else ""
            self.notices.append(
                f"no state was found{there}: a model can be trained on the result, but alignment cannot be verified, nor "
                "start-goal pairs drawn"
            )
            return []

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
        for name in dict.fromkeys(name for candidate in candidates for name in candidate):
            reason = self._unfit(name, kind)
            if reason:
                raise KeyError(f"{self.table.path} has no {kind} column for {role}: {name!r} {reason}.")
        if key == PIXELS and not there:
            advice = "take the variant with images (OGBench: visual-...), or draw frames and use from_arrays()"
        raise KeyError(f"{self.table.path} has no {kind} column for {role}: tried {tried}, got {some(there)}: {advice}.")

    def _unfit(self, name: str, kind: Kind) -> str | None:
        """What is wrong with a column of a wanted name, and what to do."""
        found = self.table.find(name)
        if found is None:
            return self.table.unusable(name)
        column = self.table.columns[found]
        if column.kind == kind:
            return None
        shape = [column.rows, *column.shape]
        if kind != "image":
            return f"holds {'frames' if column.kind == 'image' else 'text or objects'} {shape}: choose another column"
        if (name,) in OTHER_STATES and len(column.shape) < 2:
            return None  # the numbers of a file without images
        if column.kind == "number" and len(column.shape) > 1:
            return f"is no uint8 {shape}: scale it to 0..255, convert it to uint8 RGB and use from_arrays()"
        return f"holds no frames, but {shape} (encoded pictures?): decode them to uint8 RGB and use from_arrays()"

    def _count_whole(self, allow_incomplete: bool) -> int:
        """Number of episodes all of whose rows are there."""
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
        name = self.columns[PIXELS][0]
        shape = self.table.columns[name].shape
        try:
            size = shape[:2] if is_channels_last(shape) else shape[1:]
        except ValueError as error:
            raise ValueError(f"{self.table.path}: {name!r}: {error}") from error
        if not 0 < size[0] * size[1] <= MOST_PIXELS:
            raise ValueError(f"{self.table.path}: {name!r} declares frames of {list(shape)}: scale them down first.")
        return size

    def _width(self, key: str) -> int:
        width = sum(prod(self.table.columns[name].shape) for name in self.columns[key])
        if not width and self.columns[key]:
            raise ValueError(f"{self.table.path}: {some(self.columns[key], 2)} holds no number: choose another by {key}=.")
        return width

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


# ------------------------------------------------------------------ columns of known datasets


@dataclass(frozen=True)
class TaskColumns:
    """Columns that a file of one environment has to have.

    Attributes:
        states: candidates for the state in order of preference; each is a list of columns that are joined.
        state_dim: S.
        action_dim: A. Every component of these environments' actions is bounded by -1 and 1.
    """

    states: tuple[tuple[str, ...], ...]
    state_dim: int
    action_dim: int


TASKS: dict[str, TaskColumns] = {
    "two_room": TaskColumns((("state",), ("pos_agent",), ("proprio",)), state_dim=2, action_dim=2),
    "push_t": TaskColumns((("state",),), state_dim=7, action_dim=2),
    "reacher": TaskColumns((("qpos", "qvel"),), state_dim=4, action_dim=2),
    "cube": TaskColumns((("qpos", "qvel"),), state_dim=41, action_dim=5),
}

# Usual names in other data. The coordinates of the simulator come first: they restore it.
OTHER_STATES = (("state",), ("qpos", "qvel"), ("observation.state",), ("observation",), ("observations",))
OTHER_PIXELS = ("pixels", "observations", "observation.image", "image")
OTHER_ACTIONS = ("action", "actions")
