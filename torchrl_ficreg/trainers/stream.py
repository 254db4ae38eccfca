"""Feeds clips from a replay buffer to a TorchRL trainer, in the role of its collector."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torchrl import torchrl_logger

_MAPPED = (".memmap", ".blob")
_FINGERPRINT = "fingerprint"  # of a dataset: attribute of the buffer, key of the state


class ReadError(OSError):
    """A batch could not be read. No step was taken on it, and the state before it is intact."""


class ClipBuffer(Protocol):
    """What :class:`~torchrl_ficreg.trainers.OfflineTrainer` needs of a replay buffer.

    A :class:`torchrl.data.ReplayBuffer` with ``batch_size=B`` whose storage holds N clips, a tensordict [N, T], has it.
    These are used where the buffer has them:

    - ``batches_per_epoch`` (int): batches of an epoch. Default: ``len(buffer) // batch_size``.
    - ``num_frames`` (int): T. Default: that of the first clip.
    - ``sampler.rank`` and ``sampler.world_size`` (int): whose clips of each batch :meth:`sample` returns, needed with
      several ranks. Default: ``0`` and ``1``.
    - ``seek(batches)``, ``state_dict()`` and ``load_state_dict(state)``: the position in the data. Without ``seek`` a
      resumed run draws other batches than an unbroken one, and validation draws other clips each time.
    - ``fingerprint`` (str): of the data, which a resumed run compares.
    - ``data_path`` (path): folder of memory-mapped files, whose sizes are checked before every batch.
    """

    batch_size: int
    """Clips of a batch over all ranks."""

    def __len__(self) -> int:
        """Number of clips."""

    def sample(self) -> TensorDictBase:
        """The next clips of this rank, [batch_size / world_size, T]."""


class ReplayStream:
    """Endless stream of batches from a replay buffer. Its state is the position in the data.

    Args:
        replay_buffer (ClipBuffer): clips.
        device (torch.device): of the batches. Frames are copied as uint8.

    Attributes:
        waited (float): seconds spent in waiting for batches so far.

    Raises:
        ReadError: a batch could not be read. It does not count as sampled.
    """

    init_random_frames = 0

    def __init__(self, replay_buffer: ClipBuffer, device: torch.device) -> None:
        self.replay_buffer = replay_buffer
        self.device = device
        self.waited = 0.0
        self._files = FileWatch.of(replay_buffer)
        self._fingerprint = getattr(replay_buffer, _FINGERPRINT, None)

    @property
    def batches_per_epoch(self) -> int:
        """Batches of an epoch."""
        buffer = self.replay_buffer
        return getattr(buffer, "batches_per_epoch", None) or len(buffer) // buffer.batch_size

    @property
    def num_frames(self) -> int:
        """T, frames of a clip.

        Raises:
            ValueError: the buffer stores single steps, which only a transform joins into clips.
        """
        buffer = self.replay_buffer
        if frames := getattr(buffer, "num_frames", None):
            return frames
        stored = getattr(buffer, "storage", buffer)[[0]]
        if len(stored.batch_size) < 2:
            raise ValueError(
                "the training buffer stores single steps [N], expected clips [N, T]: extend it with slices of T steps (of "
                "T * frame_skip steps with an ActionBlocks transform), or use OfflineTrajectories."
            )
        return buffer[[0]].batch_size[1]

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
        """The position, with the fingerprint of the data where the buffer has one; empty for a buffer without ``seek``."""
        position = self.replay_buffer.state_dict() if hasattr(self.replay_buffer, "seek") else {}
        return position if self._fingerprint is None else {**position, _FINGERPRINT: self._fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues after the batches already sampled.

        Raises:
            ValueError: the position belongs to another number of clips, another batch size or other data.
        """
        position = dict(state_dict)
        saved = position.pop(_FINGERPRINT, None)  # absent in older checkpoints
        if position and hasattr(self.replay_buffer, "seek"):
            self.replay_buffer.load_state_dict(position)
        if saved is not None and self._fingerprint is not None and saved != self._fingerprint:
            raise ValueError(
                f"the checkpoint belongs to other data: fingerprint {saved[:12]}, here it is {self._fingerprint[:12]}."
            )

    def set_seed(self, seed: int) -> int:
        """Does nothing: the sampler has its own seed."""
        return seed

    def shutdown(self) -> None:
        """Does nothing: no process was started."""


class FileWatch:
    """Checks that the memory-mapped files of a dataset have not become shorter.

    An access beyond the end of a mapped file is not an exception but SIGBUS, which ends the process. A check takes some
    microseconds per file. A deleted file stays readable through its mapping until the process ends (on a local disk), so
    that training continues.

    Args:
        folder (path, optional): of the dataset; subfolders are included. ``None`` checks nothing.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "action.memmap"
        >>> _ = file.write_bytes(bytes(8))
        >>> watch = FileWatch(file.parent)
        >>> _ = file.write_bytes(bytes(4))
        >>> try:
        ...     watch.check()
        ... except OSError as error:
        ...     print(str(error).split("action.memmap ")[1])
        has shrunk from 8 to 4 bytes: restore it.
    """

    def __init__(self, folder: Path | str | None) -> None:
        found = () if folder is None else sorted(Path(folder).rglob("*"))
        self._size = {path: path.stat().st_size for path in found if path.suffix in _MAPPED}

    @classmethod
    def of(cls, replay_buffer: ClipBuffer) -> FileWatch:
        """For the files of a replay buffer, if it has any."""
        try:
            return cls(replay_buffer.data_path)
        except (AttributeError, RuntimeError):  # no such attribute, or a dataset in memory
            return cls(None)

    def check(self) -> None:
        """Warns once per file that was deleted.

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
