"""Format detection, and :func:`open_source` for files of every format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchrl_ficreg.data.convert.hdf5 import HDF5Table
from torchrl_ficreg.data.convert.lance import LanceTable
from torchrl_ficreg.data.convert.lerobot import INFO, LeRobotTable
from torchrl_ficreg.data.convert.ogbench import OGBenchTable
from torchrl_ficreg.data.convert.source import EpisodeSource
from torchrl_ficreg.data.convert.table import reading, some, Table
from torchrl_ficreg.data.layout import META_FILE

FORMATS: dict[str, Callable[[Path], Table]] = {
    "hdf5": HDF5Table,
    "lance": LanceTable,
    "ogbench": OGBenchTable,
    "lerobot": LeRobotTable,
}

_KNOWN = (
    "known are hdf5 (official LeWM files, stable-worldmodel), lance (stable-worldmodel), ogbench (.npz), lerobot (a "
    "folder with meta/info.json) and, from Python, from_arrays()"
)
_PACKED = (".zst", ".gz", ".tar", ".zip", ".xz")


def detect_format(path: str | Path) -> str:
    """Detects the format of a file or folder, from its first bytes or its contents.

    Args:
        path (str or Path): the file or folder.

    Returns:
        a key of :data:`FORMATS`.

    Raises:
        FileNotFoundError: there is nothing at ``path``.
        ValueError: it is none of them.

    Examples:
        >>> import tempfile, numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(f"{folder}/play.npz", terminals=[0, 1])
        ...     detect_format(f"{folder}/play.npz")
        'ogbench'
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return _detect_folder(path)
    _check_exists(path)
    with open(path, "rb") as file:
        head = file.read(8)
    if head == b"\x89HDF\r\n\x1a\n":
        return "hdf5"
    if head[:4] == b"PK\x03\x04" and path.suffix != ".zip":
        return "ogbench"
    if path.suffix in _PACKED:
        raise ValueError(f"{path} is compressed: unpack it first (for .tar.zst: tar --zstd -xf {path.name}).")
    if head[:7] == b"version":
        raise ValueError(f"{path} is a pointer to a large file, not the file: fetch it with git lfs pull.")
    raise ValueError(f"{path} has no known format; {_KNOWN}: name it by format= if it is one of them.")


def _check_exists(path: Path) -> None:
    if not path.exists():
        raise FileNotFoundError(f"no file or folder at {path}: correct the path.")
    if not (path.is_file() or path.is_dir()):  # reading a pipe would wait for its writing process
        raise ValueError(f"{path} is neither a file nor a folder, but a pipe or a device: copy the data to a file.")


def _detect_folder(path: Path) -> str:
    if (path / "_versions").is_dir():
        return "lance"
    if (path / INFO).is_file():
        return "lerobot"
    if (path / META_FILE).is_file():
        raise ValueError(f"{path} is a dataset of this package already: open it with OfflineTrajectories.")
    names = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")}
    if {"ep_len.npz", "ep_offset.npz"} <= names:
        raise ValueError(
            f"{path} is a folder of stable-worldmodel with a file per column, or with videos, which is not read: write it "
            "as HDF5 or Lance there, or load its arrays and frames and use from_arrays(pixels=..., action=..., lengths=...)."
        )
    inside = sorted(name for name in names if Path(name).suffix in (".h5", ".hdf5", ".lance", ".npz"))
    if inside:
        raise ValueError(f"{path} is a folder of data sets: choose one of {some(inside)} in it.")
    raise ValueError(f"{path} has no known format; {_KNOWN}.")


def open_source(
    path: str | Path,
    format: str = "auto",
    *,
    allow_incomplete: bool = False,
    **source: Any,
) -> EpisodeSource:
    """Opens a file or folder with episodes in another format.

    Args:
        path (str or Path): the file or folder.
        format (str, optional): a key of :data:`FORMATS`. Default: ``"auto"``, see :func:`detect_format`.

    Keyword Args:
        allow_incomplete (bool, optional): leave out the episodes that an interrupted recording did not finish.
            Default: ``False``.
        **source: ``env``, ``state``, ``pixels``, ``action``, ``shift`` and ``skip_bad_episodes`` of
            :class:`EpisodeSource`.

    Returns:
        the episodes, for :func:`convert`, to be closed after use.

    Raises:
        FileNotFoundError: there is nothing at ``path``.
        ImportError: the format needs a package that is missing.
        KeyError: a column is missing.
        ValueError: an unknown format, or a file that is damaged, incomplete or of another layout.
    """
    path = Path(path).expanduser()
    if format != "auto" and format not in FORMATS:
        raise ValueError(f"unknown format {format!r}: choose auto or one of {sorted(FORMATS)}.")
    _check_exists(path)
    reader = FORMATS[detect_format(path) if format == "auto" else format]
    with reading(path):
        # Tables of the other formats are checked by the lengths of their columns, in EpisodeSource.
        options = {"allow_incomplete": True} if allow_incomplete and reader in (OGBenchTable, LeRobotTable) else {}
        table = reader(path, **options)
    try:
        with reading(path):
            return EpisodeSource(table, allow_incomplete=allow_incomplete, **source)
    except BaseException:
        table.close()
        raise
