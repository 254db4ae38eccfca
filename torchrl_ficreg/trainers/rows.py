"""A table on disk that grows row by row and survives kills and full disks."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchrl import torchrl_logger

from torchrl_ficreg._utils import BINARY, NO_FOLLOW, NO_WAIT, read_bytes, write_all, write_atomic

_STEP = re.compile(r"\d{1,18}", re.ASCII)


class CsvRows:
    """Appends rows to a CSV file. A row may bring new columns: the file is then rewritten, in one piece, with them.

    When the disk is full, or the file cannot be written for another reason, a warning is given once, what was written
    of the row is taken back, and rows wait in memory until there is room again.

    Args:
        path: the file; made, with its folder, by the first row.
        first: columns that come first, whether or not a row has them yet.

    Examples:
        >>> import tempfile
        >>> rows = CsvRows(Path(tempfile.mkdtemp()) / "table.csv")
        >>> rows.append({"step": 1, "loss": 0.5})
        >>> rows.append({"step": 2, "rank": 3.0})
        >>> rows.path.read_text().split()
        ['step,loss,rank', '1,0.5,', '2,,3']
    """

    def __init__(self, path: Path, first: Iterable[str] = ()) -> None:
        self.path, self._first = path, tuple(first)
        self._columns: list[str] | None = None
        self._waiting: list[dict[str, Any]] = []
        self._warned = False

    def append(self, row: dict[str, Any]) -> None:
        """Writes a row, and those that waited for room."""
        self._waiting.append(row)
        try:
            self._flush()
        except OSError as error:
            if not self._warned:
                torchrl_logger.warning(f"{self.path} cannot be written ({error}): rows wait in memory until it can be.")
            self._warned = True
        else:
            self._warned = False

    def _flush(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        present, old = self._header(), []
        columns = list(dict.fromkeys([*(present or self._first), *(key for row in self._waiting for key in row)]))
        if columns != present:
            if present:
                header, rows = _read(self.path)
                old = [dict(zip(header, row)) for row in rows]
            self._replace(columns, [*old, *self._waiting])
        else:
            _append(self.path, _lines(columns, self._waiting))
        self._columns, self._waiting = columns, []

    def _header(self) -> list[str] | None:
        """Columns of the file; None where there is no file, or none with a header."""
        if self._columns is None and self.path.exists():
            self._columns = _read(self.path)[0] or None
        return self._columns if self.path.exists() else None

    def _replace(self, columns: list[str], rows: list[dict[str, Any]]) -> None:
        write_atomic(self.path, _lines(columns, [dict(zip(columns, columns)), *rows]))

    def drop_after(self, step: int) -> None:
        """Removes whole rows of later steps, and torn or damaged ones of any, in one piece.

        Raises:
            ValueError: the header is damaged, or there is no regular file.
        """
        self._columns, self._waiting = None, []
        if not self.path.exists():
            return
        header, rows = _read(self.path)  # a kill may leave an empty file
        whole = [row for row in rows if len(row) == len(header) and _STEP.fullmatch(row[0])]
        kept = [dict(zip(header, row)) for row in whole if int(row[0]) <= step]
        if kept:
            self._replace(header, kept)
        else:
            self.path.unlink()


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table; rows that cannot be read are left out.

    Raises:
        ValueError: the header cannot be read, or there is no regular file.
    """
    first, *lines = read_bytes(path).decode(errors="replace").split("\n")
    try:
        header = next(csv.reader([first]), [])
    except csv.Error as error:
        raise ValueError(f"{path} is damaged ({error}, in its first line): restore it, or move it away.") from error
    rows = []
    for line in lines:
        try:
            rows += csv.reader([line])
        except csv.Error:  # a field of more than 128 kB
            continue
    return header, [row for row in rows if row]


def _lines(columns: list[str], rows: list[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="")
    writer.writerows({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows)
    return text.getvalue()


def _append(path: Path, text: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | NO_FOLLOW | NO_WAIT | BINARY)
    try:
        before = os.fstat(descriptor).st_size
        try:
            write_all(descriptor, text.encode())
        except OSError:
            os.ftruncate(descriptor, before)
            raise
    finally:
        os.close(descriptor)
