"""Clips, strided sub-trajectories cut out of episodes when they are read, and the order in which they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import SamplerWithoutReplacement, TensorStorage
from torchrl.data.replay_buffers import Storage

from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.data.store import EpisodeStore
from torchrl_ficreg.keys import ACTION, EPISODE, LATENT, MASK, PIXELS, STATE, STEP

CLIP_KEYS = (PIXELS, ACTION, STATE, EPISODE, STEP, LATENT)


class ClipStorage(TensorStorage):
    """A read-only storage whose items are the clips of some episodes.

    A clip with T frames and frame skip F begins at some row s of an episode::

        row      s           s+F         s+2F        s+3F
        pixels   frame 0     frame 1     frame 2     frame 3
        action   [--block 0-)[--block 1-)[--block 2-)[--block 3-)

    Block k holds the F raw actions of rows s+kF ... s+(k+1)F-1, one after another: it leads from frame k to
    frame k+1. Every row at which all T frames lie in the episode begins a clip, so an episode of L rows has
    L - (T-1) F of them, and only the last block can leave its episode (the last row of an episode has no
    action): it is then zero, and ``mask`` is false there.

    Clips are numbered episode after episode, start after start, which makes any sampler of indices a sampler
    of clips, and the uniform one uniform over all legal starts. The arrays are never written to.

    Args:
        store (EpisodeStore): the recorded episodes.
        episodes (sequence of int): ids of the episodes to cut clips from. Those shorter than a clip contribute none.

    Keyword Args:
        num_frames (int): T.
        frame_skip (int): F, environment steps from one frame to the next.
        keys (sequence of str, optional): what a clip holds: ``pixels`` uint8 [T, 3, H, W], ``action`` float32
            [T, F * A] (and with it ``mask`` bool [T]), ``state`` float64 [T, S], ``episode`` int64 [T], ``step``
            int64 [T], and, with ``latent`` below, ``latent`` float32 [T, D]. Default: ``("pixels", "action")``.
        statistics (ActionStatistics, optional): z-scores the actions. Default: ``None``, environment units.
        latent (Tensor, optional): latents of all rows of these episodes, float32 [N, D], episode after episode; see
            :func:`~torchrl_ficreg.data.encode_episodes`. Default: ``None``.

    Attributes:
        num_short_episodes: number of episodes that are shorter than a clip.

    Raises:
        KeyError: an unknown key, none, or ``latent`` without latents.
        ValueError: no episode is long enough for a clip, T or F is not positive, or the latents belong to other rows.

    Examples:
        >>> step = np.arange(12)
        >>> episode = {
        ...     "pixels": np.zeros((12, 3, 4, 4), np.uint8),
        ...     "action": np.where(step < 11, step, 0).astype(np.float32)[:, None],
        ...     "state": np.zeros((12, 1)),
        ... }
        >>> clips = ClipStorage(EpisodeStore.from_episodes([episode]), [1], num_frames=3, frame_skip=4)
        >>> len(clips)
        4
        >>> clips[0]["action"].tolist(), clips[0]["mask"].tolist()  # rows 8..11, and row 11 has no action
        ([[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [0.0, 0.0, 0.0, 0.0]], [True, True, False])
        >>> clips[[0, 3]]["pixels"].shape
        torch.Size([2, 3, 3, 4, 4])
    """

    def __init__(
        self,
        store: EpisodeStore,
        episodes: Sequence[int] | np.ndarray,
        *,
        num_frames: int,
        frame_skip: int,
        keys: Sequence[str] = (PIXELS, ACTION),
        statistics: ActionStatistics | None = None,
        latent: torch.Tensor | None = None,
    ) -> None:
        if num_frames < 1 or frame_skip < 1:
            raise ValueError(f"num_frames and frame_skip must be positive, got {num_frames} and {frame_skip}.")
        if not keys or not set(keys) <= set(CLIP_KEYS):
            raise KeyError(f"a clip holds some of {CLIP_KEYS}, got keys={tuple(keys)}.")
        if LATENT in keys and latent is None:
            raise KeyError("clips hold latents only if they are given: latent=encode_episodes(dataset, encode).")
        if STATE in keys:
            store.require_state()
        self.store, self.statistics, self.keys = store, statistics, tuple(keys)
        self.num_frames, self.frame_skip = num_frames, frame_skip
        episodes = np.asarray(episodes, dtype=np.int64)
        if latent is not None:
            length = store.length[episodes - 1]
            check_latents(latent, length.sum(), "these episodes have")
            self._latent = latent.detach().float().cpu().numpy()  # [N, D]
            self._latent_row = np.zeros(len(store.length), dtype=np.int64)  # first row of each of these episodes
            self._latent_row[episodes - 1] = np.cumsum(length) - length
        starts = store.length[episodes - 1] - clip_length(num_frames, frame_skip) + 1  # [E] legal starts of each
        self._episode = episodes[starts > 0]
        self._stop_clip = np.cumsum(starts[starts > 0])  # [E], one past the last clip number of each
        if not len(self._episode):
            need = f"{clip_length(num_frames, frame_skip)} rows ({num_frames} frames, {frame_skip} steps apart)"
            lengths = store.length[episodes - 1]
            have = f"{lengths.min()} to {lengths.max()} rows" if len(lengths) else "no rows"
            raise ValueError(
                f"a clip needs {need}, but the {len(episodes)} episodes have {have}: shorten the clip or record more."
            )
        self.num_short_episodes = len(episodes) - len(self._episode)
        super().__init__(None, max_size=int(self._stop_clip[-1]))
        self.initialized = True

    def __len__(self) -> int:
        return self.max_size

    @property
    def shape(self) -> torch.Size:
        """[number of clips]."""
        return torch.Size([self.max_size])

    def get(self, index: int | slice | Sequence[int] | np.ndarray | torch.Tensor | tuple) -> TensorDict:
        """Reads clips.

        Args:
            index (int, slice or array of int): clip numbers, of any shape.

        Returns:
            A tensordict of batch size [*index.shape, T]: [T] for one number, [B, T] for a list of B.

        Raises:
            IndexError: a number beyond the last clip.
            TypeError: an index that does not hold integers.
        """
        first, stop, episode = self._locate(index)  # each [B...]
        frame = first[..., None] + np.arange(self.num_frames) * self.frame_skip  # [B..., T]
        self.store.check_files()
        clip: dict[str, Any] = {}
        for key in self.keys:
            if key == ACTION:
                clip[ACTION], clip[MASK] = self._blocks(frame, stop)
            elif key == EPISODE:
                clip[key] = torch.from_numpy(np.broadcast_to(episode[..., None], frame.shape).copy())
            elif key == STEP:
                clip[key] = torch.from_numpy(frame - self.store.start[episode - 1][..., None])
            elif key == PIXELS:
                clip[key] = torch.from_numpy(self.store.frames(frame))  # [B..., T, 3, H, W]
            elif key == LATENT:
                row = self._latent_row[episode - 1][..., None] + frame - self.store.start[episode - 1][..., None]
                clip[key] = torch.from_numpy(np.take(self._latent, row, axis=0))  # [B..., T, D]
            else:
                clip[key] = torch.from_numpy(np.take(self.store.arrays[key], frame, axis=0))  # [B..., T, S]
        # A device is needed for pinning: TorchRL leaves tensordicts without one alone.
        return TensorDict(clip, batch_size=frame.shape, device="cpu")

    def _locate(self, index: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First row of each clip, one past the last row of its episode, and that episode."""
        if isinstance(index, tuple) and len(index) == 1:
            (index,) = index
        if isinstance(index, slice):
            index = np.arange(*index.indices(len(self)))
        index = np.asarray(index)
        if index.dtype == bool:
            index = np.flatnonzero(index)
        if index.size and index.dtype.kind not in "iu":
            raise TypeError(f"clips are picked by integers, got an index of {index.dtype}.")
        clip = np.where(index < 0, index + len(self), index).astype(np.int64)
        if clip.size and (clip.min() < 0 or clip.max() >= len(self)):
            raise IndexError(f"clip numbers run from 0 to {len(self) - 1}, got {index.min()} to {index.max()}.")
        which = np.searchsorted(self._stop_clip, clip, side="right")
        episode = self._episode[which]
        stop = self.store.start[episode - 1] + self.store.length[episode - 1]
        # Counted back from the end: the last clip of an episode ends on its last row.
        first = stop - clip_length(self.num_frames, self.frame_skip) - (self._stop_clip[which] - 1 - clip)
        return first, stop, episode

    def _blocks(self, frame: np.ndarray, stop: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Action blocks [..., T, F * A] and their mask [..., T]."""
        last = stop[..., None] - 1  # [..., 1], the row without an action
        mask = torch.from_numpy(frame + self.frame_skip <= last)  # [..., T]
        rows = np.minimum(frame[..., None] + np.arange(self.frame_skip), last[..., None])  # [..., T, F]
        # np.take: several times as fast as arrays[rows] where a row is a few numbers.
        block = torch.from_numpy(np.take(self.store.arrays[ACTION], rows, axis=0))  # [..., T, F, A]
        block = block.flatten(-2)  # [..., T, F * A]
        if self.statistics is not None:
            block = self.statistics.normalize(block)
        # Selected rather than multiplied, and after z-scoring: a masked block is zero, not minus mean over std.
        return torch.where(mask[..., None], block, block.new_zeros(())), mask

    def set(self, *args: Any, **kwargs: Any) -> None:
        """Refuses: recorded clips are not written to."""
        raise RuntimeError("recorded clips cannot be changed: write new episodes with EpisodeWriter.")

    def _empty(self) -> None:
        self.set()

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the data is on disk already and must not travel with every checkpoint."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""

    def dumps(self, path: Any) -> None:
        """Nothing to save, as in :meth:`state_dict`."""

    def loads(self, path: Any) -> None:
        """Nothing to restore."""

    def __getstate__(self) -> dict[str, Any]:
        # TensorStorage would move its tensors to shared memory here; the store maps its files again instead.
        state = Storage.__getstate__(self)
        state.pop("_len_value", None)
        return state


def check_latents(latent: torch.Tensor, num_frames: int, owner: str) -> None:
    """Refuses latents that are not one vector [D] for each of so many frames.

    Raises:
        ValueError: they are not [num_frames, D].
    """
    if latent.ndim != 2 or len(latent) != num_frames:
        raise ValueError(
            f"{owner} {num_frames} frames, got latents {list(latent.shape)}: encode the same split with encode_episodes."
        )


def clip_length(num_frames: int, frame_skip: int) -> int:
    """Rows an episode needs to hold one clip, from its first frame to its last.

    Args:
        num_frames (int): T.
        frame_skip (int): F.

    Examples:
        >>> clip_length(num_frames=4, frame_skip=5)
        16
    """
    return (num_frames - 1) * frame_skip + 1


class ClipSampler(SamplerWithoutReplacement):
    """Draws every clip exactly once per epoch, in an order that depends on nothing but the seed.

    Epoch e visits the clips in the order ``permutation(seed, e)``, and batch k of a run is the k-th piece of that
    endless sequence of epochs. The position is therefore one number, :attr:`batches`, and :meth:`seek` reaches any
    position at once: a resumed run continues with the very batch it would have drawn. Neither the global random
    state nor the replay buffer's generator is used.

    An item is whatever the storage counts; with :class:`~torchrl_ficreg.data.ClipStorage` it is a clip.

    Processes that train one model together divide every batch: the sampler of each draws the whole batch and returns
    the share of its rank. The shares together are the batch that one process would have drawn, and the position is the
    same number on every rank, so that a run may be continued with another world size.

    Keyword Args:
        shuffle (bool, optional): ``False`` visits the clips in their stored order, in every epoch. Default: ``True``.
        drop_last (bool, optional): leave out the last clips of an epoch when they do not fill a batch. With ``False``
            the last batch of an epoch is shorter; several ranks then leave out what is not at least two clips for
            each. Default: ``True``.
        seed (int, optional): not negative. Default: ``0``.
        rank (int, optional): of this process, from 0. Default: ``0``.
        world_size (int, optional): number of processes that divide every batch. Default: ``1``.

    Attributes:
        batches: number of batches drawn so far.

    Raises:
        ValueError: a negative seed or an impossible rank; when drawing: fewer clips than one batch, a batch that the
            ranks cannot divide equally, or another batch size or number of clips than before, under which the
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
        self,
        *,
        shuffle: bool = True,
        drop_last: bool = True,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        super().__init__(drop_last=drop_last, shuffle=shuffle)
        if seed < 0:
            raise ValueError(f"seed must not be negative, got {seed}.")
        if not 0 <= rank < world_size:
            raise ValueError(
                f"rank must be at least 0 and below world_size, got rank={rank} and world_size={world_size}."
            )
        self.seed = int(seed)
        self.rank = int(rank)
        self.world_size = int(world_size)
        self.batches = 0
        self._batch_size = 0  # 0: nothing drawn yet
        self._num_clips = 0
        self._order: tuple[int, np.ndarray] | None = None  # epoch and its permutation

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict[str, Any]]:
        """The next batch of clip numbers, or the share of this rank: int64 [batch_size / world_size]."""
        self._bind(len(storage), batch_size)
        per_epoch = self.batches_per_epoch(len(storage), batch_size)
        epoch, batch = divmod(self.batches, per_epoch)
        index = self._epoch_order(epoch)[batch * batch_size : (batch + 1) * batch_size]
        share = len(index) // self.world_size  # exact: only whole batches are divided among ranks
        index = index[self.rank * share : (self.rank + 1) * share]
        self.batches += 1
        left = per_epoch - 1 - batch
        # TorchRL's iteration and prefetching read these two. `ran_out` is set first: a prefetching thread that read
        # the count of the next epoch before it would run into that epoch.
        self._ran_out = left == 0
        self._remaining_batches = left or per_epoch
        return torch.from_numpy(index.copy()), {}

    def batches_per_epoch(self, num_clips: int, batch_size: int) -> int:
        """Batches of one epoch.

        Args:
            num_clips (int): items of the storage.
            batch_size (int): clips of a batch, over all ranks.
        """
        served = num_clips - num_clips % self.world_size
        if self.world_size > 1 and served >= batch_size and served % batch_size < 2 * self.world_size:
            served -= served % batch_size  # a statistic over the batch needs two clips on every rank
        return served // batch_size if self.drop_last else -(served // -batch_size)

    def seek(self, batches: int) -> None:
        """Moves to a position: the next batch is batch number ``batches``, counted from 0.

        Args:
            batches (int): number of batches that count as drawn.

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
        return len(storage) >= (batch_size if self.drop_last else self.world_size)

    def state_dict(self) -> dict[str, int]:
        """Plain numbers. With prefetching, ``batches`` is ahead of what was served: see :class:`OfflineTrajectories`."""
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
        if batch_size % self.world_size:
            raise ValueError(
                f"{self.world_size} processes cannot share a batch of {batch_size} clips equally: choose a multiple of "
                f"{self.world_size}."
            )
        if batch_size < 1 or num_clips < (batch_size if self.drop_last else self.world_size):
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
        # The permutation has as many numbers as the dataset has clips, and can be made again.
        return {**super().__getstate__(), "_order": None}
