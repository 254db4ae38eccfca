"""OGBench files: compressed numpy archives, read as a stream."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from torchrl_ficreg.data.convert.table import Bounds, Column, Table

TERMINALS = "terminals"
_SKIP_BYTES = 1024 * 1024


class NpzTable(Table):
    """Flat ``observations``, ``actions`` and ``terminals``; a visual file has its frames in ``observations``.

    ::

        row           0  1  2  3 | 4  5 ...
        observations  s0 s1 s2 s3| s0 s1
        actions       a0 a1 a2 - | a0 a1          what stands in the last row of an episode leads nowhere
        terminals     0  0  0  1 | 0  0           1 marks the row of the last observation

    An archive cannot be entered in the middle: rows are read in order, and going back means starting again.

    Args:
        path: the file.

    Raises:
        ValueError: the archive is damaged, incomplete or without ``terminals``.
    """

    format = "ogbench"

    def __init__(self, path: Path) -> None:
        try:
            self._archive = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} cannot be opened ({error}): it is damaged or incomplete, copy it again.") from error
        try:
            names = [name.removesuffix(".npy") for name in self._archive.namelist()]
            if TERMINALS not in names:
                raise ValueError(f"{path} has no {TERMINALS!r}, got {sorted(names)}: use from_arrays(..., lengths=...).")
            self._members = {name: _Member(self._archive, name) for name in names}
            columns = {name: member.column for name, member in self._members.items()}
            super().__init__(path, columns, *_bounds(self._members[TERMINALS], path))
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
    """One array of the archive, read forwards."""

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
        self._row_bytes = self.dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        self.close()

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


def _bounds(terminals: _Member, path: Path) -> Bounds:
    ends = np.flatnonzero(terminals.read(0, terminals.column.rows).reshape(-1)) + 1
    if not len(ends) or ends[-1] != terminals.column.rows:
        raise ValueError(f"{path}: the last episode has no terminal row: the file is incomplete, copy it again.")
    lengths = np.diff(ends, prepend=0)
    return Bounds(ends - lengths, lengths)
