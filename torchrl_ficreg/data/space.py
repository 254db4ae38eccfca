"""Is there room for a dataset? Asked before the first byte is written."""

from __future__ import annotations

import shutil
from pathlib import Path

_RESERVE = 256 * 2**20  # bytes left alone: logs, checkpoints, the rest of the system


def require_space(path: str | Path, num_bytes: int) -> None:
    """Checks that a folder, which need not exist yet, can take so many bytes more.

    Args:
        path: where they will be written.
        num_bytes: how many.

    Raises:
        OSError: there is less free space than that and a reserve of 256 MiB.

    Examples:
        >>> require_space("somewhere/new", 1)
    """
    place = Path(path).expanduser().absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if num_bytes + _RESERVE > free:
        raise OSError(
            f"{path} needs {num_bytes / 1e9:.2f} GB and {place} has {free / 1e9:.2f} GB free: record fewer episodes or "
            "smaller frames, or write to another disk."
        )
