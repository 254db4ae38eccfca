"""Feeds a replay buffer of clips to a TorchRL trainer, which asks for a collector."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger
from torchrl.data import ReplayBuffer


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


_FINGERPRINT = "fingerprint"  # of a dataset: attribute of the buffer, key of the state


class ReadError(OSError):
    """A batch could not be read. Nothing was learned from it, and the state before it is whole."""


class ReplayStream:
    """An endless stream of batches in the place of a collector; the position in the data is its whole state.

    Args:
        replay_buffer: clips; its ``state_dict`` is a position. A ``fingerprint`` of its data, where it has one, is kept
            with the position.
        device: where batches go. Frames travel as uint8.

    Attributes:
        waited: seconds so far in which a batch was asked for and not yet there.

    Raises:
        ReadError: a batch could not be read. It does not count as handed out.
    """

    init_random_frames = 0

    def __init__(self, replay_buffer: ReplayBuffer, device: torch.device) -> None:
        self.replay_buffer, self.device = replay_buffer, device
        self.waited = 0.0
        self._files = FileWatch.of(replay_buffer)
        self._fingerprint = getattr(replay_buffer, _FINGERPRINT, None)

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            began = time.perf_counter()
            try:
                self._files.check()
                batch = self.replay_buffer.sample().to(self.device, non_blocking=True)
            except (OSError, ValueError) as error:
                raise ReadError(f"the clips cannot be read: {error}") from error
            self.waited += time.perf_counter() - began
            yield batch

    def state_dict(self) -> dict[str, Any]:
        """The position: batches handed out, and of how many clips, which size and, where it is known, which data."""
        known = {} if self._fingerprint is None else {_FINGERPRINT: self._fingerprint}
        return {**self.replay_buffer.state_dict(), **known}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues after the batches already handed out.

        Raises:
            ValueError: the position belongs to another number of clips, another batch size or other data.
        """
        position = dict(state_dict)
        theirs = position.pop(_FINGERPRINT, None)  # older checkpoints have none
        self.replay_buffer.load_state_dict(position)
        if theirs is not None and self._fingerprint is not None and theirs != self._fingerprint:
            raise ValueError(
                f"the checkpoint belongs to other data: fingerprint {theirs[:12]}, here it is {self._fingerprint[:12]}."
            )

    def set_seed(self, seed: int) -> int:
        """The sampler carries its own seed."""
        return seed

    def shutdown(self) -> None:
        """There is no process to end."""
