"""Is there room for a dataset? Asked before the first byte is written."""

from __future__ import annotations

import shutil
from pathlib import Path

_RESERVE = 256 * 2**20  # most bytes left alone: logs, checkpoints, the rest of the system
_RESERVED_PART = 0.02  # and no more than this part of a small disk


def nearest_folder(path: Path) -> Path:
    """A folder, or the nearest one there is above it."""
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    return place


def require_space(path: str | Path, num_bytes: int) -> None:
    """Checks that a folder, which need not exist yet, can take so many bytes more.

    Args:
        path: where they will be written.
        num_bytes: how many.

    Raises:
        OSError: there is less free space than that and a reserve: 256 MiB, or 2 % of a disk smaller than 13 GB.

    Examples:
        >>> require_space("somewhere/new", 1)
    """
    place = nearest_folder(Path(path).expanduser())
    total, _, free = shutil.disk_usage(place)
    reserve = min(_RESERVE, int(total * _RESERVED_PART))
    if num_bytes + reserve > free:
        raise OSError(
            f"{path} needs {num_bytes / 1e6:.1f} MB and a reserve of {reserve / 1e6:.1f} MB, {place} has "
            f"{free / 1e6:.1f} MB free: record fewer episodes or smaller frames, or write to another disk."
        )
