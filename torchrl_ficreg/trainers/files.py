"""Are the files still there that clips are read from?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl import torchrl_logger

_MAPPED = (".memmap", ".blob")


class FileWatch:
    """Looks, before a batch is read, whether the mapped files of a dataset are as long as they were.

    Touching a mapped page beyond the end of its file is no exception but SIGBUS, which ends a process on the spot. A
    look costs some microseconds a file. A file that was removed stays readable through its mapping as long as this
    process lives (on a local disk), so training goes on; the next process will not find it.

    Args:
        folder: of the dataset; folders below it are watched too. None watches nothing.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "action.memmap").write_bytes(bytes(8))
        >>> watch = FileWatch(folder)
        >>> watch.check()
    """

    def __init__(self, folder: Path | str | None) -> None:
        found = () if folder is None else sorted(Path(folder).rglob("*"))
        self._size = {path: path.stat().st_size for path in found if path.suffix in _MAPPED}

    @classmethod
    def of(cls, replay_buffer: Any) -> FileWatch:
        """Watches the files of a replay buffer, where it has any."""
        return cls(getattr(getattr(replay_buffer, "_store", None), "path", None))

    def check(self) -> None:
        """Warns, once, of a file that has vanished.

        Raises:
            OSError: a file has become shorter.
        """
        for path, before in list(self._size.items()):
            try:
                size = path.stat().st_size
            except FileNotFoundError:
                del self._size[path]
                torchrl_logger.warning(f"{path} has vanished: this process can still read it, the next one cannot.")
                continue
            if size < before:
                raise OSError(f"{path} has shrunk from {before} to {size} bytes: restore it.")
