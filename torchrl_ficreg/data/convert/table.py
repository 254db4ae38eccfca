"""What every foreign file is to us: a table of rows, episode after episode, with named columns."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal, NamedTuple

import numpy as np

Kind = Literal["number", "image", "text"]


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        shape: of one row; that of the decoded picture for encoded frames.
        kind: ``"image"`` is uint8 with at least two axes, or an encoded picture; ``"text"`` is anything that holds
            no numbers.
        rows: how many there are; fewer than the episodes promise where a recording was interrupted.
    """

    shape: tuple[int, ...]
    kind: Kind
    rows: int


class Table(ABC):
    """A foreign file, opened.

    Args:
        path: the file or folder, for messages and for the record.
        columns: name -> what it holds.
        starts: int64 [E], first row of each episode, increasing.
        lengths: int64 [E], rows of each episode.

    Raises:
        ValueError: there is no episode.
    """

    format: str

    def __init__(self, path: Path, columns: Mapping[str, Column], starts: np.ndarray, lengths: np.ndarray) -> None:
        if not len(lengths):
            raise ValueError(f"{path} holds no episode: there is nothing to convert.")
        self.path = path
        self.columns = dict(columns)
        self.starts = np.asarray(starts, np.int64)
        self.lengths = np.asarray(lengths, np.int64)

    @abstractmethod
    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows ``start`` to ``stop`` of a column.

        Returns:
            [stop - start, *shape], pictures decoded.
        """

    def close(self) -> None:
        """Releases the file."""

    def find(self, name: str) -> str | None:
        """The column of that name, where ``/``, ``.`` and ``_`` are the same letter; ``None`` if there is none."""
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
    """Where episodes lie.

    Attributes:
        starts: int64 [E], first rows.
        lengths: int64 [E], numbers of rows.
    """

    starts: np.ndarray
    lengths: np.ndarray


def bounds_from_ids(ids: np.ndarray, where: str | Path) -> Bounds:
    """Finds the episodes in a column that names the episode of every row.

    Args:
        ids: [N] integers, equal within an episode.
        where: names the file in errors.

    Raises:
        ValueError: the rows of an episode are not next to each other.

    Examples:
        >>> bounds_from_ids(np.array([4, 4, 4, 7, 7]), "file")
        Bounds(starts=array([0, 3]), lengths=array([3, 2]))
    """
    ids = np.asarray(ids).reshape(-1)
    if not len(ids):
        return Bounds(np.zeros(0, np.int64), np.zeros(0, np.int64))
    starts = np.flatnonzero(np.concatenate([[True], ids[1:] != ids[:-1]]))
    first_ids = ids[starts]
    if len(np.unique(first_ids)) != len(first_ids):
        values, counts = np.unique(first_ids, return_counts=True)
        raise ValueError(
            f"{where}: the rows of episode {values[counts > 1][0]} are not next to each other: sort the file by "
            "episode and step first."
        )
    return Bounds(starts, np.diff(np.append(starts, len(ids))))


def check_steps(steps: np.ndarray, bounds: Bounds, where: str | Path) -> None:
    """Checks that a step column counts 0, 1, 2, ... within every episode.

    Args:
        steps: [N] integers.
        bounds: of the episodes that cover the N rows.
        where: names the file in errors.

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


def require(module: str, package: str | None = None) -> ModuleType:
    """Imports an optional module.

    Raises:
        ImportError: it is missing; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        needed = package or module
        raise ImportError(f"this format needs {needed}: pip install 'torchrl_ficreg[data]' ({error}).") from error
