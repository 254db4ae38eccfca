"""OGBench files: compressed numpy archives, read as streams."""

from __future__ import annotations

import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from torchrl_ficreg.data.convert.table import Bounds, brief, Column, MOST_ROWS, runs, some, Table

TERMINALS = "terminals"
_SKIP_BYTES = 1024 * 1024


class OGBenchTable(Table):
    """Flat ``observations``, ``actions`` and ``terminals``; in files of visual tasks ``observations`` are the frames.

    ::

        row           0  1  2  3 | 4  5 ...
        observations  s0 s1 s2 s3| s0 s1
        actions       a0 a1 a2 - | a0 a1          the action in the last row of an episode is not used
        terminals     0  0  0  1 | 0  0           1 marks the row of the last observation

    A compressed array can only be read from its beginning: rows are read in order, and an earlier row starts again.

    Args:
        path (Path): the file.

    Keyword Args:
        allow_incomplete (bool, optional): leave out the rows after the last terminal one. Default: ``False``.

    Raises:
        ValueError: the archive is damaged, incomplete or without ``terminals``.
    """

    format = "ogbench"

    def __init__(self, path: Path, *, allow_incomplete: bool = False) -> None:
        try:
            self._archive = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} cannot be opened ({error}): it is damaged or incomplete, copy it again.") from error
        try:
            names = [name.removesuffix(".npy") for name in self._archive.namelist()]
            if TERMINALS not in names:
                raise ValueError(f"{path} has no {TERMINALS!r}, got {sorted(names)}: use from_arrays(..., lengths=...).")
            self._members, self.left_out = {}, {}
            for name in names:
                try:
                    self._members[name] = _Member(self._archive, name)
                except Exception as error:  # stray members, objects, damage: an error only if the array is needed
                    self.left_out[name] = f"cannot be read: {brief(error)}"
            if TERMINALS in self.left_out:
                raise ValueError(
                    f"{path} cannot be read ({TERMINALS!r} {brief(self.left_out[TERMINALS])}): it is damaged, copy it again."
                )
            columns = {name: member.column for name, member in self._members.items()}
            terminals = self._members[TERMINALS]
            rows = {column.rows for name, column in columns.items() if name != TERMINALS}
            if columns[TERMINALS].shape not in ((), (1,)) or terminals.column.rows not in rows:
                raise ValueError(
                    f"{path}: {TERMINALS!r} has shape {[terminals.column.rows, *terminals.column.shape]}, the other arrays "
                    f"have {some([str(count) for count in sorted(rows)])} rows: the file is damaged."
                )
            bounds, rest = _bounds(terminals, path)
            if rest:
                escape = f", or pass allow_incomplete=True to take the {len(bounds.lengths)} whole episodes"
                if not (allow_incomplete and len(bounds.lengths)):
                    raise ValueError(
                        f"{path}: the last episode has no terminal row: the file is incomplete, copy it again"
                        f"{escape if len(bounds.lengths) else ''}."
                    )
                self.notices = [f"the {rest} rows after the last whole episode are left out"]
            super().__init__(path, columns, *bounds)
        except (OSError, EOFError, NotImplementedError, zlib.error, zipfile.BadZipFile) as error:
            self._archive.close()
            raise ValueError(f"{path} cannot be read ({error}): it is damaged, copy it again.") from error
        except BaseException:
            self._archive.close()
            raise

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads on to the rows of an array; see :meth:`Table.read`."""
        return self._members[name].read(start, stop)

    def close(self) -> None:
        """Closes the archive."""
        for member in self._members.values():
            member.close()
        self._archive.close()


class _Member:
    """One array of the archive, read in order."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive, self._name = archive, f"{name}.npy" if f"{name}.npy" in archive.namelist() else name
        self._stream: IO[bytes] | None = None
        self._row = 0
        self._open()
        rows, *shape = self._shape
        kind = "text" if self.dtype.kind not in "biuf" else "number"
        if self.dtype == np.uint8 and len(shape) > 1:
            kind = "image"
        self.column = Column(tuple(shape), kind, rows)
        self._row_bytes = self.dtype.itemsize * prod(shape)
        self.close()
        size = archive.getinfo(self._name).file_size
        if rows * self._row_bytes > size or rows > MOST_ROWS or not self._row_bytes:
            raise ValueError(f"it declares {rows} rows of shape {shape}, and holds {size} bytes")

    def read(self, start: int, stop: int) -> np.ndarray:
        if self._stream is None or start < self._row:
            self.close()
            self._open()
        self._skip((start - self._row) * self._row_bytes)
        content = self._stream.read((stop - start) * self._row_bytes)
        self._row = stop
        return np.frombuffer(content, self.dtype).reshape(-1, *self.column.shape)

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _open(self) -> None:
        self._stream, self._row = self._archive.open(self._name), 0
        version = npy.read_magic(self._stream)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        self._shape, fortran, self.dtype = header(self._stream)
        if fortran and len(self._shape) > 1 or not self._shape:
            raise ValueError(f"{self._name} is stored column by column or holds one value: save it again row by row.")

    def _skip(self, count: int) -> None:
        while count:
            got = len(self._stream.read(min(count, _SKIP_BYTES)))
            if not got:
                raise EOFError("the array ends early")
            count -= got


def _bounds(terminals: _Member, path: Path) -> tuple[Bounds, int]:
    """The episodes that end in a terminal row, and the number of rows after them."""
    starts, values = runs(terminals.read, terminals.column.rows)
    if not np.isin(values, (0, 1)).all():
        wrong = int(np.flatnonzero(~np.isin(values, (0, 1)))[0])
        raise ValueError(
            f"{path}: {TERMINALS!r} holds {values[wrong]} in row {starts[wrong]}: 0 or 1 is expected, the file is damaged."
        )
    stops = np.append(starts[1:], terminals.column.rows)
    ends = [np.arange(start, stop) + 1 for start, stop, value in zip(starts, stops, values) if value]
    ends = np.concatenate([np.zeros(0, np.int64), *ends])
    lengths = np.diff(ends, prepend=0)
    return Bounds(ends - lengths, lengths), terminals.column.rows - int(ends[-1] if len(ends) else 0)
