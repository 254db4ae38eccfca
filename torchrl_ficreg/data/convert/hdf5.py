"""HDF5 files: the official LeWM data and what current stable-worldmodel writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.table import Bounds, bounds_from_ids, Column, require, Table

LENGTH, OFFSET = "ep_len", "ep_offset"
EPISODE_IDS = ("episode_idx", "ep_idx")

# A chunk of the official files is 100 frames of 224 x 224, 15 MB. h5py's own cache of 1 MB holds none, so that every
# chunk an episode shares with its neighbour would be decompressed twice.
_CHUNK_CACHE_BYTES = 64 * 1024 * 1024


class HDF5Table(Table):
    """Flat arrays over all rows, with the episodes in ``ep_len`` and ``ep_offset``, or in ``ep_idx``/``episode_idx``.

    ::

        row         0 1 2 3 | 4 5 6 | ...      any dataset of N rows is a column; a/b may be a group or a name
        ep_idx      0 0 0 0 | 1 1 1 |          int32 [N], not in current stable-worldmodel files
        ep_len      4         3                [E]
        ep_offset   0         4                [E]

    Args:
        path: the file.

    Raises:
        ImportError: h5py or hdf5plugin (for Blosc) is missing.
        ValueError: the file is damaged, or holds no episodes in this layout.
    """

    format = "hdf5"

    def __init__(self, path: Path) -> None:
        h5py = require("h5py")
        require("hdf5plugin")  # registers Blosc by being imported
        try:
            self._file = h5py.File(path, "r", rdcc_nbytes=_CHUNK_CACHE_BYTES, rdcc_nslots=10_007)
        except OSError as error:
            raise ValueError(f"{path} cannot be opened ({error}): it is damaged or still being written.") from error
        try:
            datasets: dict[str, Any] = {}
            self._file.visititems(lambda name, item: _keep(datasets, name, item))
            bounds = _episodes(datasets, path)
            self._datasets = {name: data for name, data in datasets.items() if name not in (LENGTH, OFFSET)}
            columns = {name: _describe(data) for name, data in self._datasets.items()}
            super().__init__(path, columns, *bounds)
        except BaseException:
            self._file.close()
            raise

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows of a dataset; see :meth:`Table.read`."""
        return self._datasets[name][start:stop]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def _keep(datasets: dict[str, Any], name: str, item: Any) -> None:
    if hasattr(item, "shape") and item.shape:  # neither a group nor a single value
        datasets[name] = item


def _describe(data: Any) -> Column:
    rows, *shape = data.shape
    kind = "text" if data.dtype.kind not in "biuf" else "image" if data.dtype == np.uint8 and len(shape) > 1 else "number"
    return Column(tuple(shape), kind, rows)


def _episodes(datasets: dict[str, Any], path: Path) -> Bounds:
    """Reads the episodes, from whichever description there is, and compares where there are two."""
    ids = next((datasets[name] for name in EPISODE_IDS if name in datasets), None)
    if LENGTH not in datasets:
        if ids is None:
            raise ValueError(
                f"{path} has neither {LENGTH!r} nor {' nor '.join(map(repr, EPISODE_IDS))}, got {sorted(datasets)}: "
                "read the arrays yourself and use from_arrays(..., lengths=...)."
            )
        return bounds_from_ids(ids[:], path)
    lengths = np.asarray(datasets[LENGTH][:], np.int64).reshape(-1)
    if (lengths < 1).any():
        raise ValueError(f"{path}: {LENGTH} holds {int(lengths.min())}: the file is damaged, copy it again.")
    starts = np.cumsum(lengths) - lengths
    if OFFSET in datasets:
        starts = np.asarray(datasets[OFFSET][:], np.int64).reshape(-1)
        if starts.shape != lengths.shape or (starts < 0).any() or (starts[:-1] + lengths[:-1] > starts[1:]).any():
            raise ValueError(f"{path}: {OFFSET} and {LENGTH} contradict each other: the file is damaged.")
    if ids is not None:
        found = ids[:].reshape(-1)
        for start, length in zip(starts, lengths):
            rows = found[start : start + length]
            if len(rows) and (rows != rows[0]).any():
                raise ValueError(f"{path}: rows {start} to {start + length} belong to several episodes: it is damaged.")
    return Bounds(starts, lengths)
