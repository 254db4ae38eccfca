"""A replay buffer whose position in the data is one number."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

from torchrl_ficreg._utils import read_json, write_atomic
from torchrl_ficreg.data.sampler import ClipSampler

_STATE_FILE = "position.json"


class SeekableReplayBuffer(TensorDictReplayBuffer):
    """A TorchRL replay buffer that resumes at the exact batch, with or without prefetching.

    Its sampler counts batches *drawn*, which with prefetching runs ahead of those *handed out*. This buffer counts
    the latter, and since batch k is a function of the seed and k alone, :meth:`seek` can drop what was prefetched
    and draw it again.

    Args:
        **kwargs: as for :class:`~torchrl.data.TensorDictReplayBuffer`; the sampler must be a
            :class:`~torchrl_ficreg.data.ClipSampler`.

    Raises:
        TypeError: another sampler.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not isinstance(self._sampler, ClipSampler):
            raise TypeError(f"only a ClipSampler can be sought, got a {type(self._sampler).__name__}.")
        self._delivered = 0
        self._use_one_reader()

    @property
    def batches(self) -> int:
        """Batches handed out so far; those that were prefetched and not handed out do not count."""
        return self._delivered

    @property
    def part(self) -> tuple[int, int]:
        """(r, n): which of how many equal pieces of every batch is served."""
        return self._sampler.part

    @property
    def batches_per_epoch(self) -> int:
        """Batches that visit every item once.

        Raises:
            RuntimeError: the buffer was made without a batch size.
        """
        if self._batch_size is None:
            raise RuntimeError("an epoch has a number of batches only if batch_size is given to the constructor.")
        return self._sampler.batches_per_epoch(len(self._storage), self._batch_size)

    def seek(self, batches: int) -> None:
        """Continues with batch number ``batches``, as if that many had been handed out.

        Raises:
            ValueError: a negative number.
        """
        with self._futures_lock:
            self._clear_prefetch_queue_locked()
            with self._replay_lock:
                self._sampler.seek(batches)
                self._delivered = self._sampler.batches

    def sample(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """The next batch; ``index`` holds the numbers of its items. As TorchRL's ``sample``."""
        with self._futures_lock:
            batch = super().sample(*args, **kwargs)
            self._delivered += 1
        return batch

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields what is left of the current epoch, or a whole one if none has begun."""
        for _ in range(self.batches_per_epoch - self._delivered % self.batches_per_epoch):
            yield self.sample()

    def state_dict(self) -> dict[str, int]:
        """The position, as plain numbers: neither the data nor prefetched batches are in it."""
        with self._futures_lock, self._replay_lock:
            return {**self._sampler.state_dict(), "batches": self._delivered}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues at a saved position, with the saved seed.

        Raises:
            ValueError: the position was saved with another batch size or another number of items.
        """
        saved = (int(state_dict["num_clips"]), int(state_dict["batch_size"]))
        here = (len(self._storage), self._batch_size or saved[1])
        if any(saved) and saved != here:
            raise ValueError(
                f"the position was saved for {saved[0]} clips in batches of {saved[1]}, here are {here[0]} in batches "
                f"of {here[1]}: repeat the first settings, or begin again."
            )
        with self._futures_lock:
            self._clear_prefetch_queue_locked()
            with self._replay_lock:
                self._sampler.load_state_dict(state_dict)
                self._delivered = self._sampler.batches

    def dumps(self, path: str | Path) -> None:
        """Saves :meth:`state_dict` in a directory."""
        Path(path).mkdir(parents=True, exist_ok=True)
        write_atomic(Path(path) / _STATE_FILE, json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Loads what :meth:`dumps` saved."""
        self.load_state_dict(read_json(Path(path) / _STATE_FILE, "position"))

    def _use_one_reader(self) -> None:
        # TorchRL starts as many threads as batches to prefetch. They take turns at one lock in no fixed order, so
        # that batches could swap places; one thread reads as fast and keeps the order.
        if self._prefetch:
            self._prefetch_executor.shutdown(wait=False)
            self._prefetch_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="clips")

    def __getstate__(self) -> dict[str, Any]:
        # TorchRL copies the prefetched batches here. A spawned process would get them by file descriptors, which are
        # closed with the copies, before it has started; it draws these batches again.
        return {**super().__getstate__(), "_prefetch_state": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._use_one_reader()
        self.seek(self._delivered)
