"""Common interface of source files: a table of rows with named columns, episode after episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

Kind = Literal["number", "image", "text"]

MOST_ROWS = 1_000_000_000  # of one file; a small file can declare more than fits in memory
_PIECE_ROWS = 1_000_000  # rows read at once from a column that covers the whole file


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        shape: of one row; for encoded frames that of the decoded picture.
        kind: ``"image"`` is uint8 with at least two axes, or an encoded picture; ``"text"`` is anything without numbers.
        rows: number of rows; fewer than the episodes need where a recording was interrupted.
    """

    shape: tuple[int, ...]
    kind: Kind
    rows: int


class Table(ABC):
    """An opened source file.

    A new format is a subclass that finds the columns and episodes in its constructor and implements :meth:`read`.

    Args:
        path (Path): the file or folder, for messages and for the converted dataset.
        columns (dict): name -> :class:`Column`.
        starts (ndarray): int64 [E], first row of each episode, increasing.
        lengths (ndarray): int64 [E], rows of each episode.

    Raises:
        ValueError: there is no episode.
    """

    format: str
    notices: Sequence[str] = ()  # what was left out on request, for the warnings of a conversion
    left_out: Mapping[str, str] = {}  # name -> why it cannot be read as a column

    def __init__(self, path: Path, columns: Mapping[str, Column], starts: np.ndarray, lengths: np.ndarray) -> None:
        if not len(lengths):
            raise ValueError(f"{path} holds no episode: there is nothing to convert.")
        self.path = path
        self.columns = dict(columns)
        self.starts = np.asarray(starts, np.int64)
        self.lengths = np.asarray(lengths, np.int64)

    def unusable(self, name: str) -> str | None:
        """The reason why something of that name in the file cannot be read as a column; None where there is nothing."""
        plain = _plain(name)
        return next((reason for other, reason in self.left_out.items() if _plain(other) == plain), None)

    @abstractmethod
    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows ``start`` to ``stop`` of a column.

        Returns:
            [stop - start, *shape], pictures decoded.
        """

    def close(self) -> None:
        """Releases the file."""

    def find(self, name: str) -> str | None:
        """The column of that name, with ``/``, ``.`` and ``_`` taken for the same character; ``None`` if there is none."""
        if name in self.columns:
            return name
        plain = _plain(name)
        return next((column for column in self.columns if _plain(column) == plain), None)

    def of_kind(self, kind: Kind) -> list[str]:
        """The names of the columns of one kind, sorted."""
        return sorted(name for name, column in self.columns.items() if column.kind == kind)


def _plain(name: str) -> str:
    return name.replace("/", "_").replace(".", "_")


class Bounds(NamedTuple):
    """Positions of the episodes in a table.

    Attributes:
        starts: int64 [E], first rows.
        lengths: int64 [E], numbers of rows.
    """

    starts: np.ndarray
    lengths: np.ndarray


def bounds_from_ids(ids: np.ndarray, where: str | Path) -> Bounds:
    """Finds the episodes in a column that names the episode of every row.

    Args:
        ids (ndarray): [N] integers, equal within an episode.
        where (str or Path): name of the file, for errors.

    Raises:
        ValueError: the rows of an episode are not next to each other.

    Examples:
        >>> bounds_from_ids(np.array([4, 4, 4, 7, 7]), "file")
        Bounds(starts=array([0, 3]), lengths=array([3, 2]))
    """
    ids = np.asarray(ids).reshape(-1)
    return _bounds(*runs(lambda start, stop: ids[start:stop], len(ids)), len(ids), where)


def bounds_from_reader(read: Callable[[int, int], np.ndarray], rows: int, where: str | Path) -> Bounds:
    """As :func:`bounds_from_ids`, for a column that is read in pieces.

    Args:
        read (callable): ``read(start, stop)`` returns those rows of the column.
        rows (int): N.
        where (str or Path): name of the file, for errors.

    Raises:
        ValueError: the rows of an episode are not next to each other.
    """
    return _bounds(*runs(read, rows), rows, where)


def runs(read: Callable[[int, int], np.ndarray], rows: int) -> tuple[np.ndarray, np.ndarray]:
    """First rows of the runs of equal values, int64 [R], and the values [R], of a column that is read in pieces."""
    starts, values, last = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], None
    for start in range(0, rows, _PIECE_ROWS):
        piece = np.asarray(read(start, min(start + _PIECE_ROWS, rows))).reshape(-1)
        changed = np.concatenate([[last is None or piece[0] != last], piece[1:] != piece[:-1]])
        starts.append(start + np.flatnonzero(changed))
        values.append(piece[changed])
        last = piece[-1]
    return np.concatenate(starts), np.concatenate(values)


def _bounds(starts: np.ndarray, first_ids: np.ndarray, rows: int, where: str | Path) -> Bounds:
    if len(np.unique(first_ids)) != len(first_ids):
        values, counts = np.unique(first_ids, return_counts=True)
        raise ValueError(
            f"{where}: the rows of episode {values[counts > 1][0]} are not next to each other: sort the file by "
            "episode and step first."
        )
    return Bounds(starts, np.diff(np.append(starts, rows)))


def check_steps(steps: np.ndarray, bounds: Bounds, where: str | Path) -> None:
    """Checks that a step column counts 0, 1, 2, ... within every episode.

    Args:
        steps (ndarray): [N] integers.
        bounds (Bounds): of the episodes that cover the N rows.
        where (str or Path): name of the file, for errors.

    Raises:
        ValueError: it does not: rows are missing or in another order.
    """
    expected = np.arange(len(steps)) - np.repeat(bounds.starts, bounds.lengths)
    wrong = np.flatnonzero(np.asarray(steps).reshape(-1) != expected)
    if len(wrong):
        row = int(wrong[0])
        raise ValueError(
            f"{where}: row {row} holds step {int(steps[row])}, expected {int(expected[row])}: rows are missing or out "
            "of order; sort the file by episode and step, or export it again."
        )


def brief(error: object, limit: int = 110) -> str:
    """The message of another library's error, in one line of at most ``limit`` characters."""
    text = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
    text = text or type(error).__name__
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


def some(names: Sequence[str], most: int = 6) -> str:
    """The first few of many names.

    Examples:
        >>> some(["a", "b", "c"], 2)
        "'a', 'b' and 1 more"
    """
    first = ", ".join(repr(brief(name, 40)) for name in names[:most])
    return f"{first} and {len(names) - most} more" if len(names) > most else first or "nothing"


def is_foreign(error: BaseException) -> bool:
    """Whether an error was raised by a library: a panic of a Rust library derives from BaseException only."""
    return isinstance(error, Exception) or type(error).__module__.startswith("pyo3")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Converts whatever a library raises about a file into one ValueError that names the file.

    Raises:
        ValueError: instead of any error apart from missing packages or files and errors that name the file already.
    """
    try:
        yield
    except (ImportError, FileNotFoundError, PermissionError):
        raise
    except BaseException as error:
        ours = isinstance(error, (ValueError, KeyError)) and error.args and str(path) in str(error.args[0])
        if ours or not is_foreign(error):
            raise
        what = "does not fit in memory" if isinstance(error, MemoryError) else brief(error)
        raise ValueError(f"{path} cannot be read ({what}): it is damaged or incomplete, copy it again.") from error


def check_inside(file: Path, folder: Path) -> None:
    """Refuses whatever is no regular file, and links that lead out of the folder of the data set.

    Raises:
        ValueError: with the name of the file.
    """
    root = folder.resolve()
    if root.parent.name == "snapshots" and (root.parent.parent / "blobs").is_dir():
        root = root.parent.parent  # the download cache of Hugging Face keeps the files of a snapshot beside it
    place = file.resolve()
    if not place.is_relative_to(root):
        raise ValueError(f"{file} is a link that leads out of {folder.name}: copy the data set with its files (cp -rL).")
    if not place.is_file():
        raise ValueError(f"{file} is no regular file: copy the data set again.")
