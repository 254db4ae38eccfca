"""HDF5 files: the official LeWM data and those of current stable-worldmodel."""

from __future__ import annotations

import posixpath
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg._utils import require
from torchrl_ficreg.data.convert.table import Bounds, bounds_from_reader, brief, Column, MOST_ROWS, runs, some, Table

LENGTH, OFFSET = "ep_len", "ep_offset"
EPISODE_IDS = ("episode_idx", "ep_idx")

# A chunk of the official files is 100 frames of 224 x 224, 15 MB. h5py's own cache of 1 MB holds none of them: every
# chunk with frames of two episodes would be decompressed twice.
_CHUNK_CACHE_BYTES = 64 * 1024 * 1024
_MOST_CHUNK_BYTES = 512 * 1024 * 1024  # unpacked to read one row; compressed, a small file can declare 4 GB


class HDF5Table(Table):
    """Flat arrays over all rows, with the episodes in ``ep_len`` and ``ep_offset``, or in ``ep_idx``/``episode_idx``.

    ::

        row         0 1 2 3 | 4 5 6 | ...      any dataset of N rows is a column; a/b may be a group or a name
        ep_idx      0 0 0 0 | 1 1 1 |          int32 [N], not in current stable-worldmodel files
        ep_len      4         3                [E]
        ep_offset   0         4                [E]

    Args:
        path (Path): the file.

    Raises:
        ImportError: h5py or hdf5plugin (for Blosc) is missing.
        ValueError: the file is damaged, or holds no episodes in this layout.
    """

    format = "hdf5"

    def __init__(self, path: Path) -> None:
        h5py = require("h5py", "data", purpose="HDF5")
        require("hdf5plugin", "data", purpose="HDF5")  # registers Blosc by being imported
        try:
            self._file = h5py.File(path, "r", rdcc_nbytes=_CHUNK_CACHE_BYTES, rdcc_nslots=10_007)
        except OSError as error:
            advice = "it is damaged or still being written"
            if "unable to lock file" in str(error) and "errno = 11" not in str(error):
                advice = "this file system has no locks: set HDF5_USE_FILE_LOCKING=FALSE in the environment"
            raise ValueError(f"{path} cannot be opened ({brief(error)}): {advice}.") from error
        try:
            datasets, self.left_out = _find_datasets(self._file)
            columns = {}
            for name, data in datasets.items():
                column = _describe(data)
                if isinstance(column, str):
                    self.left_out[name] = column
                else:
                    columns[name] = column
            self._datasets = {name: datasets[name] for name in columns if name not in (LENGTH, OFFSET)}
            bounds = _episodes({name: datasets[name] for name in columns}, self.left_out, path)
            super().__init__(path, {name: columns[name] for name in self._datasets}, *bounds)
        except BaseException:
            self._file.close()
            raise

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows of a dataset; see :meth:`Table.read`."""
        return self._datasets[name][start:stop]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def _find_datasets(file: Any) -> tuple[dict[str, Any], dict[str, str]]:
    """All arrays of a file, also those reached by soft links, and the reasons why others are left out.

    Whatever would read another file is left out: a file from elsewhere must not copy private files into a dataset.
    """
    h5py = require("h5py", "data", purpose="HDF5")
    datasets: dict[str, Any] = {}
    left_out: dict[str, str] = {}
    links: dict[str, str] = {}
    seen: set[Any] = set()
    pending = [("", file)]
    while pending:
        prefix, group = pending.pop()
        address = h5py.h5o.get_info(group.id).addr
        if address in seen:  # a group may hold a link to itself
            continue
        seen.add(address)
        for name in group:
            full = f"{prefix}{name}"
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):
                links[full] = posixpath.normpath(posixpath.join("/", prefix, link.path)).lstrip("/")
            elif not isinstance(link, h5py.HardLink):
                left_out[full] = f"is a link to another file ({brief(link.filename, 60)}), which is not followed"
            else:
                item = group[name]
                if isinstance(item, h5py.Group):
                    pending.append((f"{full}/", item))
                elif isinstance(item, h5py.Dataset) and item.shape:  # neither a type nor a single value
                    datasets[full] = item
    for name in [name for name, data in datasets.items() if data.external]:
        left_out[name] = "has its values in another file (external storage), which is not followed"
        del datasets[name]
    sources = {name for name, data in datasets.items() if not data.is_virtual}
    for name in datasets.keys() - sources:
        # In the order of HDF5 "." is this file. A source that is virtual itself could lead on to another one.
        parts = datasets[name].virtual_sources()
        if any(part.file_name != "." or part.dset_name.lstrip("/") not in sources for part in parts):
            left_out[name] = "is a virtual data set of other files, which are not followed"
            del datasets[name]
    for _ in range(len(links)):  # links to links
        before = len(links)
        for name, place in list(links.items()):
            inside = {found[len(place) :]: data for found, data in datasets.items() if f"{found}/".startswith(f"{place}/")}
            if inside:
                datasets.update({f"{name}{rest}": data for rest, data in inside.items()})
                del links[name]
        if len(links) == before:
            break
    left_out |= {name: f"is a link to {brief(place, 60)!r}, which is no array of this file" for name, place in links.items()}
    return datasets, left_out


def _describe(data: Any) -> Column | str:
    """Describes an array, or says why it cannot be read."""
    rows, *shape = data.shape
    try:
        dtype = data.dtype
    except TypeError as error:
        return f"has a type that numpy does not know ({brief(error, 60)})"
    piece = prod(data.chunks) * dtype.itemsize if data.chunks else 0
    if piece > _MOST_CHUNK_BYTES:
        return f"is stored in chunks of {piece} bytes, of which a row needs one: write it with chunks of a few rows"
    kind = "text" if dtype.kind not in "biuf" else "image" if dtype == np.uint8 and len(shape) > 1 else "number"
    return Column(tuple(shape), kind, rows)


def _episodes(datasets: dict[str, Any], left_out: dict[str, str], path: Path) -> Bounds:
    """Reads where the episodes are, from ``ep_len`` or from episode ids, and compares them where there are both."""
    for name in (LENGTH, OFFSET):
        if name in left_out:
            raise ValueError(f"{path}: {name!r} {left_out[name]}: copy it into the file.")
    ids = next((datasets[name] for name in EPISODE_IDS if name in datasets), None)
    others = [data.shape[0] for name, data in datasets.items() if name not in (LENGTH, OFFSET)]
    rows = max(others, default=0)
    if ids is not None:
        _check_declared(ids, min(rows, MOST_ROWS), path)
    if LENGTH not in datasets:
        if ids is None:
            raise ValueError(_without_episodes(datasets, path))
        return bounds_from_reader(lambda start, stop: ids[start:stop], ids.shape[0], path)
    lengths = _integers(datasets[LENGTH], rows, path)
    if (lengths < 1).any():
        raise ValueError(f"{path}: {LENGTH} holds {int(lengths.min())}: the file is damaged, copy it again.")
    if float(lengths.sum(dtype=np.float64)) > 2**62:
        raise ValueError(f"{path}: {LENGTH} holds {int(lengths.max())} rows: the file is damaged, copy it again.")
    starts = np.cumsum(lengths) - lengths
    if OFFSET in datasets:
        if datasets[OFFSET].shape == datasets[LENGTH].shape:
            starts = _integers(datasets[OFFSET], rows, path)
        if datasets[OFFSET].shape != datasets[LENGTH].shape or not _in_order(starts, lengths):
            raise ValueError(f"{path}: {OFFSET} and {LENGTH} contradict each other: the file is damaged.")
    if ids is not None:
        changes, _ = runs(lambda start, stop: ids[start:stop], ids.shape[0])
        within = np.searchsorted(changes, starts + lengths, "left") - np.searchsorted(changes, starts, "right")
        if within.any():
            start, length = (int(bound[np.flatnonzero(within)[0]]) for bound in (starts, lengths))
            raise ValueError(f"{path}: rows {start} to {start + length} belong to several episodes: it is damaged.")
    return Bounds(starts, lengths)


def _in_order(starts: np.ndarray, lengths: np.ndarray) -> bool:
    return bool((starts >= 0).all() and (starts[:-1] <= starts[1:] - lengths[:-1]).all())


def _check_declared(data: Any, most: int, path: Path) -> None:
    """Refuses an array that declares more values than were written, before any memory is allocated."""
    name = data.name.lstrip("/")
    if data.size > most or (not data.id.get_storage_size() and data.size and not data.is_virtual):
        raise ValueError(f"{path}: {name!r} declares {data.size} values, more than were written: the file is damaged.")


def _integers(data: Any, most: int, path: Path) -> np.ndarray:
    """Reads ``ep_len`` or ``ep_offset``."""
    _check_declared(data, most, path)
    name, values = data.name.lstrip("/"), None
    if data.dtype.kind in "iuf":
        values = data[:].reshape(-1)
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.int64)
        if (whole == values).all():
            return whole
    got = f"{values[np.flatnonzero(whole != values)[0]]}" if values is not None else f"values of type {data.dtype}"
    raise ValueError(f"{path}: {name!r} must hold whole numbers, got {got}: the file is damaged, or write it as integers.")


def _without_episodes(datasets: dict[str, Any], path: Path) -> str:
    """The error message for a file without a description of its episodes."""
    groups: dict[str, set[str]] = {}
    for name in datasets:
        for depth in range(1, min(name.count("/"), 2) + 1):
            parts = name.split("/")
            groups.setdefault("/".join(parts[:depth]), set()).add("/".join(parts[depth:]))
    alike = [name for name in groups if sum(groups[other] == groups[name] for other in groups) > 1]
    if alike:
        return (
            f"{path} keeps every episode in a group of its own ({len(alike)} groups such as {brief(alike[0], 40)!r}): "
            "join their arrays and use from_arrays(pixels=..., action=..., lengths=...)."
        )
    return (
        f"{path} has neither {LENGTH!r} nor {' nor '.join(map(repr, EPISODE_IDS))}, got {some(sorted(datasets))}: read "
        "the arrays yourself and use from_arrays(..., lengths=...)."
    )
