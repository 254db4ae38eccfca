"""The offline dataset: recorded episodes as a TorchRL replay buffer of clips."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.datasets.utils import _get_root_dir
from torchrl.envs.utils import _classproperty

from torchrl_ficreg._utils import read_json, write_atomic
from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.data.clips import ClipSampler, ClipStorage
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.data.store import EpisodeStore, Verify
from torchrl_ficreg.keys import ACTION, DONE, EPISODE, PIXELS, STATE, STEP


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


Split = Literal["train", "validation", "evaluation", "all"]

SPLITS = ("train", "validation", "evaluation")

_GOLDEN = (5**0.5 - 1) / 2


def split_episodes(
    num_episodes: int, split: Split, *, fractions: tuple[float, float, float] = (0.8, 0.1, 0.1), seed: int = 0
) -> np.ndarray:
    """Ids of the episodes of a split.

    Episode e falls where ``frac(offset(seed) + e * 0.618...)`` lies among the cumulative fractions. It depends
    on nothing but e and the seed, so an episode never changes its split when the dataset grows; and because
    multiples of the golden ratio are evenly spread, every prefix of a dataset has nearly the exact fractions.

    Args:
        num_episodes: episodes in the dataset, with ids 1 to ``num_episodes``.
        split: ``"train"``, ``"validation"``, ``"evaluation"`` or ``"all"``.
        fractions: parts of train, validation and evaluation; not negative, train positive, summing to 1.
        seed: picks the offset.

    Returns:
        int64 [E], ascending.

    Raises:
        ValueError: unknown split, or bad fractions.

    Examples:
        >>> split_episodes(10, "validation").tolist(), split_episodes(30, "validation").tolist()
        ([2, 10], [2, 10, 23])
    """
    if split != "all" and split not in SPLITS:
        raise ValueError(f"split must be one of {(*SPLITS, 'all')}, got {split!r}.")
    wrong_sum = len(fractions) != len(SPLITS) or abs(sum(fractions) - 1) > 1e-6
    if wrong_sum or min(fractions) < 0 or fractions[0] <= 0:
        raise ValueError(f"split fractions are three numbers >= 0, the first > 0, summing to 1, got {fractions}.")
    episodes = np.arange(1, num_episodes + 1)
    if split == "all":
        return episodes
    position = (np.random.default_rng(seed).random() + episodes * _GOLDEN) % 1.0  # [E] in [0, 1)
    upper = np.cumsum(fractions)
    upper[np.flatnonzero(fractions)[-1] :] = 1.0  # against rounding: the last split that is not empty reaches 1
    return episodes[np.searchsorted(upper, position, side="right") == SPLITS.index(split)]


class OfflineTrajectories(SeekableReplayBuffer, BaseDatasetExperienceReplay):
    """Serves clips of recorded episodes, for training a world model offline.

    :meth:`sample` returns a tensordict of batch size [B, T]: see :class:`~torchrl_ficreg.data.ClipStorage` for the
    picture of a clip, :class:`~torchrl_ficreg.data.ClipSampler` for the order and
    :class:`~torchrl_ficreg.data.SeekableReplayBuffer` for resuming. Iterating yields what is left of the current
    epoch. ``len(dataset)`` is its number of clips and ``dataset[i]`` the i-th of them.

    The data is read-only: ``extend`` refuses, and writing into a returned tensor never reaches the files.

    Args:
        dataset_id: a dataset directory or one of shards, its name under ``root``, a list of them, or an opened
            :class:`~torchrl_ficreg.data.EpisodeStore`, which the datasets of several splits can share.

    Keyword Args:
        root: where names are looked up. Default ``~/.cache/torchrl/torchrl_ficreg``.
        split: which episodes to serve; see :func:`~torchrl_ficreg.data.split_episodes`.
        split_fractions: parts of train, validation and evaluation.
        split_seed: seed of the split.
        num_frames: T, frames of a clip.
        frame_skip: F, environment steps from one frame to the next.
        batch_size: B, in clips, over all processes. Needed for iterating, for ``drop_last`` and for ``prefetch``.
        keys: what a clip holds, among ``pixels``, ``action`` (with ``mask``), ``state``, ``episode``, ``step``.
        statistics: z-scores the actions. Default: measured on the training episodes, whatever ``split`` is.
        shuffle: ``False`` serves clips in their stored order.
        drop_last: leave out an incomplete last batch of an epoch; has no effect without ``batch_size``.
        seed: seed of the order.
        part: (r, n) serves the r-th of n equal pieces of every batch, B / n clips: one process of n that train together.
        prefetch: batches read ahead by one background thread. The order and :meth:`state_dict` do not depend on it.
        pin_memory: put batches in pinned memory; has no effect without a CUDA device.
        transform: a TorchRL transform of sampled clips.
        allow_incomplete: accept a dataset whose collection has not reached its target.
        verify: whose checksums to compare when opening: ``"ends"`` (first and last episode), ``"full"`` or ``"none"``.

    Raises:
        FileNotFoundError: there is no such dataset.
        KeyError: an unknown key.
        ValueError: the dataset is incomplete or damaged, no episode of the split is long enough for a clip, the split
            does not fill one batch, or an argument is out of range.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> episodes = [
        ...     {
        ...         "pixels": rng.integers(0, 256, (40, 3, 8, 8), dtype=np.uint8),
        ...         "action": np.pad(rng.normal(size=(39, 2)), ((0, 1), (0, 0))).astype(np.float32),
        ...         "state": rng.normal(size=(40, 4)),
        ...     }
        ...     for _ in range(10)
        ... ]
        >>> dataset = OfflineTrajectories.from_episodes(episodes, batch_size=16, num_frames=4, frame_skip=5)
        >>> batch = dataset.sample()
        >>> batch.batch_size, batch["pixels"].shape, batch["action"].shape
        (torch.Size([16, 4]), torch.Size([16, 4, 3, 8, 8]), torch.Size([16, 4, 10]))
        >>> dataset.num_clips, dataset.batches_per_epoch  # 7 of the 10 train, with 25 starts each
        (175, 10)
    """

    def __init__(
        self,
        dataset_id: str | Path | Sequence[str | Path] | EpisodeStore,
        *,
        root: str | Path | None = None,
        split: Split = "train",
        split_fractions: tuple[float, float, float] = (0.8, 0.1, 0.1),
        split_seed: int = 0,
        num_frames: int = 4,
        frame_skip: int = 5,
        batch_size: int | None = None,
        keys: Sequence[str] = (PIXELS, ACTION),
        statistics: ActionStatistics | None = None,
        shuffle: bool = True,
        drop_last: bool = True,
        seed: int = 0,
        part: tuple[int, int] = (0, 1),
        prefetch: int | None = None,
        pin_memory: bool = False,
        transform: Callable[[TensorDictBase], TensorDictBase] | None = None,
        allow_incomplete: bool = False,
        verify: Verify = "ends",
    ) -> None:
        self.root = _get_root_dir("torchrl_ficreg") if root is None else Path(root).expanduser()
        if isinstance(dataset_id, EpisodeStore):
            store = dataset_id
        else:
            store = open_store(self._resolve(dataset_id), allow_incomplete=allow_incomplete, verify=verify)
        self.dataset_id = str(store.path or "memory") if isinstance(dataset_id, EpisodeStore) else str(dataset_id)
        self.split = split
        divide = {"fractions": tuple(split_fractions), "seed": split_seed}
        ids = split_episodes(store.num_episodes, split, **divide)
        if not len(ids):
            raise ValueError(
                f"the {split!r} split of {store.num_episodes} episodes is empty: record more (20 fill every split)."
            )
        if statistics is None:
            statistics = _measure(store, split_episodes(store.num_episodes, "train", **divide))
        elif statistics.action_dim != store.header.shapes[ACTION][0]:
            got, want = statistics.action_dim, store.header.shapes[ACTION][0]
            raise ValueError(f"statistics describe {got} action dimensions, the dataset has {want}.")
        clips = ClipStorage(
            store, ids, num_frames=num_frames, frame_skip=frame_skip, keys=keys, statistics=statistics
        )
        self._store, self._episode_ids, self._statistics = store, ids, statistics
        drop_last = drop_last and batch_size is not None
        if batch_size is not None and batch_size % part[1]:
            raise ValueError(f"{part[1]} processes cannot share a batch_size of {batch_size}: give a multiple of {part[1]}.")
        if batch_size is not None and len(clips) < (batch_size if drop_last else part[1]):
            raise ValueError(
                f"the {split!r} split holds {len(clips)} clips, less than one batch of {batch_size}: lower batch_size "
                "or pass drop_last=False."
            )
        super().__init__(
            storage=clips,
            sampler=ClipSampler(shuffle=shuffle, drop_last=drop_last, seed=seed, part=part),
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            prefetch=prefetch,
            pin_memory=pin_memory and torch.cuda.is_available(),
            transform=transform,
        )

    @classmethod
    def from_episodes(
        cls, episodes: Iterable[Mapping[str, np.ndarray]], *, meta: Mapping[str, Any] | None = None, **kwargs: Any
    ) -> OfflineTrajectories:
        """A dataset in memory, for tests and small studies.

        Args:
            episodes: see :func:`~torchrl_ficreg.data.layout.check_episode`.
            meta: what :attr:`meta` returns.
            **kwargs: as for the class.
        """
        return cls(EpisodeStore.from_episodes(episodes, meta=meta), **kwargs)

    @property
    def statistics(self) -> ActionStatistics:
        """The z-scores of ``action``: a checkpoint needs them."""
        return self._statistics

    @property
    def meta(self) -> dict[str, Any]:
        """What the collection noted about itself (a copy)."""
        return deepcopy(self._store.header.meta)

    @property
    def fingerprint(self) -> str:
        """sha256 that changes with any byte of any episode; to be stored with results."""
        return self._store.fingerprint

    @property
    def episodes(self) -> TensorDict:
        """The episodes of this split: ``episode`` (id), ``start`` (row) and ``length``, int64 [E] each."""
        position = self._episode_ids - 1
        columns = {EPISODE: self._episode_ids, "start": self._store.start[position]}
        columns["length"] = self._store.length[position]
        return TensorDict({key: torch.tensor(value) for key, value in columns.items()}, [len(position)])

    @property
    def num_clips(self) -> int:
        """Legal clip starts in this split."""
        return len(self._storage)

    @property
    def num_steps(self) -> int:
        """Rows in this split."""
        return int(self._store.length[self._episode_ids - 1].sum())

    @property
    def num_short_episodes(self) -> int:
        """Episodes of this split that are shorter than a clip and are never served."""
        return self._storage.num_short_episodes

    @property
    def num_frames(self) -> int:
        """T."""
        return self._storage.num_frames

    @property
    def frame_skip(self) -> int:
        """F."""
        return self._storage.frame_skip

    @property
    def action_dim(self) -> int:
        """A, the size of one raw action."""
        return self._statistics.action_dim

    def require_state(self) -> None:
        """Refuses a dataset without states, for what needs them; see :meth:`EpisodeStore.require_state`.

        Raises:
            ValueError: the episodes were converted without a state.
        """
        self._store.require_state()

    def row(self, episode: int, step: int) -> int:
        """The row of a step of an episode of this split.

        Raises:
            IndexError: the episode has no such step.
            KeyError: the split has no such episode.
        """
        rows = self._rows(episode)
        if not 0 <= step < rows.stop - rows.start:
            raise IndexError(f"episode {episode} has steps 0 to {rows.stop - rows.start - 1}, got {step}.")
        return rows.start + step

    def episode_data(
        self, episode: int, *, steps: slice = slice(None), keys: Sequence[str] = (PIXELS, ACTION, STATE)
    ) -> TensorDict:
        """One episode of this split, in environment units, and without a copy where the frames are raw.

        Args:
            episode: its id.
            steps: the steps wanted, forwards. Default: all L.
            keys: the columns wanted: compressed frames are decoded only on demand.

        Returns:
            [L]: ``keys``, ``episode``, ``step`` and ``("next", "done")``.

        Raises:
            KeyError: the split has no such episode.
        """
        rows = self._rows(episode)
        self._store.check_files()
        step = torch.arange(rows.stop - rows.start)[steps]
        rows = slice(*(rows.start + bound for bound in steps.indices(rows.stop - rows.start)[:2]), steps.step)
        read = {key: self._store.frames if key == PIXELS else self._store.arrays[key].__getitem__ for key in keys}
        data = TensorDict({key: torch.from_numpy(get(rows)) for key, get in read.items()}, [len(step)])
        data[EPISODE], data[STEP] = torch.full_like(step, episode), step
        data[DONE] = (step == self._store.length[episode - 1] - 1).unsqueeze(-1)  # [L, 1]
        return data

    @_classproperty
    def available_datasets(cls) -> list[str]:  # noqa: N805
        """Names of the datasets under the default root."""
        return sorted(file.parent.name for file in Path(_get_root_dir("torchrl_ficreg")).glob(f"*/{META_FILE}"))

    @property
    def data_path(self) -> Path:
        """The directory of the dataset.

        Raises:
            RuntimeError: the dataset lives in memory.
        """
        if self._store.path is None:
            raise RuntimeError("a dataset made by from_episodes() lives in memory and has no path.")
        return self._store.path

    @property
    def data_path_root(self) -> Path:
        """The directory that holds the dataset's."""
        return self.data_path.parent

    def _is_downloaded(self) -> bool:
        return self._store.num_episodes >= self._store.header.target_episodes

    def preprocess(self, *args: Any, **kwargs: Any) -> None:
        """Refuses: clips are cut when read, so there are no rows to map."""
        raise RuntimeError("clips are cut when read: pass transform=, or write new episodes with EpisodeWriter.")

    def _resolve(self, dataset_id: str | Path | Sequence[str | Path]) -> Path | list[Path]:
        if not isinstance(dataset_id, (str, Path)):
            return [self._resolve(shard) for shard in dataset_id]
        path = Path(dataset_id).expanduser()
        return path if path.is_dir() or path.is_absolute() else Path(self.root) / path

    def _rows(self, episode: int) -> slice:
        position = np.searchsorted(self._episode_ids, episode)
        if position == len(self._episode_ids) or self._episode_ids[position] != episode:
            raise KeyError(f"the {self.split!r} split has no episode {episode}: choose one of dataset.episodes.")
        return self._store.rows(episode)


def _measure(store: EpisodeStore, episodes: np.ndarray) -> ActionStatistics:
    """Statistics of the actions of some episodes, without each last row, where no action was taken."""
    rows = [store.rows(episode) for episode in episodes]
    if not rows:
        raise ValueError("the training split is empty, so it has no action statistics: record more, or pass them.")
    action = np.concatenate([store.arrays[ACTION][span.start : span.stop - 1] for span in rows])  # [N, A]
    try:
        return ActionStatistics.from_actions(torch.from_numpy(action))
    except ValueError as error:
        raise ValueError(f"{store.path or 'the dataset in memory'}: {error}") from error
