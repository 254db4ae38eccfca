"""Exact, seekable epochs over clips."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torchrl.data import SamplerWithoutReplacement
from torchrl.data.replay_buffers import Storage


class ClipSampler(SamplerWithoutReplacement):
    """Draws every clip exactly once per epoch, in an order that depends on nothing but the seed.

    Epoch e visits the clips in the order ``permutation(seed, e)``; batch k of the run is the k-th piece of that
    endless sequence of epochs. The position is therefore one number, :attr:`batches`, and :meth:`seek` reaches any
    position at once: a resumed run continues with the very batch it would have drawn. Neither the global random
    state nor the replay buffer's generator takes part.

    An item is whatever the storage counts; with :class:`~torchrl_ficreg.data.ClipStorage` it is a clip.

    Several processes that train one model share every batch: the sampler of each draws the whole batch and hands out
    its own piece. Together the pieces are the batch that one process would have drawn, and the position is the same
    number everywhere, so that a run may be continued on another number of processes.

    Keyword Args:
        shuffle: ``False`` visits the clips in their stored order, in every epoch.
        drop_last: leave out the last clips of an epoch when they do not fill a batch. With ``False`` the last
            batch of an epoch is shorter; several processes then leave out what is not at least two clips for each.
        seed: not negative.
        part: (r, n), the r-th of n equal pieces of every batch, r from 0.

    Raises:
        ValueError: a negative seed or an impossible part; when drawing: fewer clips than one batch, a batch that n
            processes cannot share equally, or another batch size or number of clips than before, under which the
            position would mean something else.

    Examples:
        >>> from torchrl.data import ReplayBuffer, TensorStorage
        >>> sampler = ClipSampler(seed=3)
        >>> buffer = ReplayBuffer(storage=TensorStorage(torch.arange(6)), sampler=sampler, batch_size=2)
        >>> first = [buffer.sample().tolist() for _ in range(3)]
        >>> sorted(sum(first, []))
        [0, 1, 2, 3, 4, 5]
        >>> sampler.seek(1)
        >>> buffer.sample().tolist() == first[1]
        True
    """

    def __init__(
        self, *, shuffle: bool = True, drop_last: bool = True, seed: int = 0, part: tuple[int, int] = (0, 1)
    ) -> None:
        super().__init__(drop_last=drop_last, shuffle=shuffle)
        if seed < 0:
            raise ValueError(f"seed must not be negative, got {seed}.")
        if not 0 <= part[0] < part[1]:
            raise ValueError(f"part is (r, n) with 0 <= r < n, got {tuple(part)}.")
        self.seed = int(seed)
        self.part = (int(part[0]), int(part[1]))
        self.batches = 0
        self._batch_size = 0  # 0: nothing drawn yet
        self._num_clips = 0
        self._order: tuple[int, np.ndarray] | None = None  # epoch and its permutation

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict[str, Any]]:
        """The next batch of clip numbers, or this process's part of it, int64 [batch_size / n]."""
        self._bind(len(storage), batch_size)
        per_epoch = self.batches_per_epoch(len(storage), batch_size)
        epoch, batch = divmod(self.batches, per_epoch)
        index = self._epoch_order(epoch)[batch * batch_size : (batch + 1) * batch_size]
        piece, pieces = self.part
        share = len(index) // pieces  # of whole batches there is no rest
        index = index[piece * share : (piece + 1) * share]
        self.batches += 1
        left = per_epoch - 1 - batch
        # TorchRL's iteration and prefetching read these two. `ran_out` goes first, since a prefetching thread
        # that saw the count of the next epoch before it would run into that epoch.
        self._ran_out = left == 0
        self._remaining_batches = left or per_epoch
        return torch.from_numpy(index.copy()), {}

    def batches_per_epoch(self, num_clips: int, batch_size: int) -> int:
        """Batches of one epoch over so many clips."""
        pieces = self.part[1]
        shared = num_clips - num_clips % pieces
        if pieces > 1 and shared >= batch_size and shared % batch_size < 2 * pieces:
            shared -= shared % batch_size  # a statistic of the batch needs two clips on every process
        return batches_per_epoch(shared, batch_size, self.drop_last)

    def seek(self, batches: int) -> None:
        """Makes ``batches`` the number of batches drawn so far: the next one is batch number ``batches``.

        Raises:
            ValueError: a negative number.
        """
        if batches < 0:
            raise ValueError(f"batches must not be negative, got {batches}.")
        self.batches = int(batches)
        self._ran_out = False
        if self._batch_size:
            per_epoch = self.batches_per_epoch(self._num_clips, self._batch_size)
            self._remaining_batches = per_epoch - self.batches % per_epoch

    def can_sample(self, storage: Storage, batch_size: int) -> bool:
        """Whether the storage fills one batch."""
        return len(storage) >= (batch_size if self.drop_last else self.part[1])

    def state_dict(self) -> dict[str, int]:
        """Plain numbers. With prefetching, ``batches`` counts those not yet handed out: see ``OfflineTrajectories``."""
        return {
            "seed": self.seed,
            "shuffle": int(self.shuffle),
            "drop_last": int(self.drop_last),
            "batches": self.batches,
            "batch_size": self._batch_size,
            "num_clips": self._num_clips,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues the saved order, whatever seed this sampler was made with."""
        self._empty()
        self.seed = int(state_dict["seed"])
        self.shuffle, self.drop_last = bool(state_dict["shuffle"]), bool(state_dict["drop_last"])
        self._batch_size, self._num_clips = int(state_dict["batch_size"]), int(state_dict["num_clips"])
        self.seek(int(state_dict["batches"]))

    def __repr__(self) -> str:
        flags = f"shuffle={self.shuffle}, drop_last={self.drop_last}, seed={self.seed}"
        return f"{type(self).__name__}({flags}, batches={self.batches})"

    def _bind(self, num_clips: int, batch_size: int) -> None:
        if batch_size % self.part[1]:
            raise ValueError(
                f"{self.part[1]} processes cannot share a batch of {batch_size} clips equally: choose a multiple of "
                f"{self.part[1]}."
            )
        if batch_size < 1 or num_clips < (batch_size if self.drop_last else self.part[1]):
            raise ValueError(
                f"{num_clips} clips do not fill a batch of {batch_size}: lower batch_size or pass drop_last=False."
            )
        if not self._batch_size:
            self._batch_size, self._num_clips = batch_size, num_clips
        if (num_clips, batch_size) != (self._num_clips, self._batch_size):
            raise ValueError(
                f"the position counts batches of {self._batch_size} out of {self._num_clips} clips, got batches of "
                f"{batch_size} out of {num_clips}: keep both, or use a new sampler."
            )

    def _epoch_order(self, epoch: int) -> np.ndarray:
        if self._order is None or self._order[0] != epoch:
            clips = np.arange(self._num_clips)
            if self.shuffle:
                np.random.default_rng([self.seed, epoch]).shuffle(clips)
            self._order = (epoch, clips)
        return self._order[1]

    def _empty(self) -> None:
        self.batches = self._batch_size = self._num_clips = 0
        self._order = None
        self._ran_out = False

    def __getstate__(self) -> dict[str, Any]:
        # The permutation is as large as the dataset has clips, and can be made again.
        return {**super().__getstate__(), "_order": None}


def batches_per_epoch(num_clips: int, batch_size: int, drop_last: bool) -> int:
    """Batches that visit every clip once.

    Examples:
        >>> batches_per_epoch(10, 4, drop_last=True), batches_per_epoch(10, 4, drop_last=False)
        (2, 3)
    """
    return num_clips // batch_size if drop_last else -(num_clips // -batch_size)
