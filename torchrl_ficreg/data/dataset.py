"""The offline dataset: clips of recorded episodes as a TorchRL replay buffer."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ImmutableDatasetWriter
from torchrl.data.datasets.common import BaseDatasetExperienceReplay

from torchrl_ficreg._torchrl_compat import (
    classproperty,
    default_root,
    locked,
    PREFETCHED,
    prefetching_paused,
    use_one_reader,
)
from torchrl_ficreg._utils import read_json, write_atomic
from torchrl_ficreg.data.action_statistics import ActionStatistics
from torchrl_ficreg.data.clips import ClipSampler, ClipStorage
from torchrl_ficreg.data.layout import META_FILE
from torchrl_ficreg.data.shards import open_store
from torchrl_ficreg.data.store import EpisodeStore
from torchrl_ficreg.keys import ACTION, DONE, EPISODE, LATENT, PIXELS, STATE, STEP

Split = Literal["train", "validation", "evaluation", "all"]
SPLITS = ("train", "validation", "evaluation")

_STATE_FILE = "position.json"
_GOLDEN = (5**0.5 - 1) / 2
# Arguments of TorchRL's datasets that cannot have a meaning here.
_REFUSED = {
    "writer": "recorded episodes are read-only, write new ones with EpisodeWriter",
    "split_trajs": "clips are cut when read, read whole episodes with episode_data()",
    "download": "there is nothing to download, record episodes with collect_episodes() or convert() a file",
}


class OfflineTrajectories(BaseDatasetExperienceReplay):
    """Serves clips of recorded episodes, for training a world model offline.

    :meth:`sample` returns a tensordict of batch size [B, T]: see :class:`~torchrl_ficreg.data.ClipStorage` for the
    picture of a clip and :class:`~torchrl_ficreg.data.ClipSampler` for the order. Iterating yields what is left of the
    current epoch. ``len(dataset)`` is its number of clips and ``dataset[i]`` the i-th of them.

    It resumes at the exact batch, with or without prefetching: the sampler counts the batches *drawn*, which with
    prefetching is ahead of those *served*; :attr:`batches` counts the latter, and since batch k is a function of the
    seed and k alone, :meth:`seek` can discard what was prefetched and draw it again.

    The data is read-only: ``extend`` refuses, and writing into a returned tensor never reaches the files.

    Args:
        dataset_id (str, Path, sequence of them, or EpisodeStore): a dataset directory or one of shards, its name under
            ``root``, a list of them, or an opened store, which the datasets of several splits can share. See
            :func:`~torchrl_ficreg.data.open_store` for incomplete datasets and other checks of checksums.
        batch_size (int, optional): B, in clips, over all ranks. Needed for iterating, for ``drop_last`` and for
            ``prefetch``. Default: ``None``, given to each :meth:`sample`.

    Keyword Args:
        root (str or Path, optional): where names are looked up. Default: ``~/.cache/torchrl/torchrl_ficreg``.
        split (str, optional): which episodes to serve: ``"train"``, ``"validation"``, ``"evaluation"`` or ``"all"``;
            see :func:`~torchrl_ficreg.data.split_episodes`. Default: ``"train"``.
        split_fractions (tuple of float, optional): fractions of train, validation and evaluation.
            Default: ``(0.8, 0.1, 0.1)``.
        split_seed (int, optional): seed of the split. Default: ``0``.
        num_frames (int, optional): T, frames of a clip. Default: ``4``.
        frame_skip (int, optional): F, environment steps from one frame to the next. Default: ``5``.
        keys (sequence of str, optional): what a clip holds, among ``pixels``, ``action`` (with ``mask``), ``state``,
            ``episode``, ``step`` and ``latent``. Default: ``("pixels", "action")``, or with ``latent`` below
            ``("latent", "action")``.
        latent (Tensor, optional): latents of all rows of the split [N, D], the result of
            :func:`~torchrl_ficreg.data.encode_episodes`. Clips of them train everything but the encoder in a fraction of
            the time. Default: ``None``.
        statistics (ActionStatistics, optional): z-scores the actions. Default: measured on the training episodes,
            whatever ``split`` is.
        sampler (ClipSampler, optional): the order. Default: ``ClipSampler(**order)``.
        collate_fn (callable, optional): as for :class:`~torchrl.data.ReplayBuffer`. Default: TorchRL's.
        prefetch (int, optional): batches read ahead by one background thread. The order and :meth:`state_dict` do not
            depend on it. Default: ``None``.
        pin_memory (bool, optional): put batches in pinned memory; has no effect without a CUDA device.
            Default: ``False``.
        transform (Transform or callable, optional): applied to sampled clips. Default: ``None``.
        **order: ``shuffle``, ``drop_last``, ``seed``, ``rank`` and ``world_size`` of the default sampler, as for
            :class:`~torchrl_ficreg.data.ClipSampler`. ``drop_last`` has no effect without ``batch_size``.

    Raises:
        FileNotFoundError: there is no such dataset.
        KeyError: an unknown key.
        TypeError: a sampler of another class, or an argument that a dataset of clips cannot have.
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
        >>> len(dataset), dataset.batches_per_epoch  # 7 of the 10 train, with 25 starts each
        (175, 10)
    """

    def __init__(
        self,
        dataset_id: str | Path | Sequence[str | Path] | EpisodeStore,
        batch_size: int | None = None,
        *,
        root: str | Path | None = None,
        split: Split = "train",
        split_fractions: tuple[float, float, float] = (0.8, 0.1, 0.1),
        split_seed: int = 0,
        num_frames: int = 4,
        frame_skip: int = 5,
        keys: Sequence[str] | None = None,
        latent: torch.Tensor | None = None,
        statistics: ActionStatistics | None = None,
        sampler: ClipSampler | None = None,
        collate_fn: Callable[[Any], Any] | None = None,
        prefetch: int | None = None,
        pin_memory: bool = False,
        transform: Callable[[TensorDictBase], TensorDictBase] | None = None,
        **order: Any,
    ) -> None:
        sampler = _make_sampler(sampler, order, batch_size)
        self.root = default_root("torchrl_ficreg") if root is None else Path(root).expanduser()
        self.store = dataset_id if isinstance(dataset_id, EpisodeStore) else open_store(self._resolve(dataset_id))
        self.dataset_id = str(self.store.path or "memory") if self.store is dataset_id else str(dataset_id)
        self.split = split
        divide = {"fractions": tuple(split_fractions), "seed": split_seed}
        self._episode_ids = split_episodes(self.store.num_episodes, split, **divide)
        if not len(self._episode_ids):
            raise ValueError(
                f"the {split!r} split of {self.store.num_episodes} episodes is empty: record more (20 fill every split)."
            )
        if statistics is None:
            statistics = _measure(self.store, split_episodes(self.store.num_episodes, "train", **divide))
        elif statistics.action_dim != self.store.header.shapes[ACTION][0]:
            got, want = statistics.action_dim, self.store.header.shapes[ACTION][0]
            raise ValueError(f"statistics describe {got} action dimensions, the dataset has {want}.")
        self.statistics = statistics
        clips = ClipStorage(
            self.store,
            self._episode_ids,
            num_frames=num_frames,
            frame_skip=frame_skip,
            keys=(PIXELS if latent is None else LATENT, ACTION) if keys is None else keys,
            statistics=statistics,
            latent=latent,
        )
        if batch_size is not None and batch_size % sampler.world_size:
            ranks = sampler.world_size
            raise ValueError(
                f"{ranks} processes cannot share a batch_size of {batch_size}: give a multiple of {ranks}."
            )
        if batch_size is not None and not sampler.can_sample(clips, batch_size):
            raise ValueError(
                f"the {split!r} split holds {len(clips)} clips, less than one batch of {batch_size}: lower batch_size "
                "or pass drop_last=False."
            )
        super().__init__(
            storage=clips,
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            collate_fn=collate_fn,
            batch_size=batch_size,
            prefetch=prefetch,
            pin_memory=pin_memory and torch.cuda.is_available(),
            transform=transform,
        )
        self._served = sampler.batches
        use_one_reader(self)

    @classmethod
    def from_episodes(
        cls, episodes: Iterable[Mapping[str, np.ndarray]], *, meta: Mapping[str, Any] | None = None, **kwargs: Any
    ) -> OfflineTrajectories:
        """A dataset in memory, for tests and small studies.

        Args:
            episodes (iterable of dict): see :func:`~torchrl_ficreg.data.layout.check_episode`.
            meta (dict, optional): what :attr:`meta` returns. Default: ``None``, empty.
            **kwargs: as for the class.
        """
        return cls(EpisodeStore.from_episodes(episodes, meta=meta), **kwargs)

    # ------------------------------------------------------------------ what it holds

    @property
    def meta(self) -> dict[str, Any]:
        """The fields that the collection wrote about itself (a copy)."""
        return deepcopy(self.store.header.meta)

    @property
    def fingerprint(self) -> str:
        """sha256 that changes with any byte of any episode; to be stored with results."""
        return self.store.fingerprint

    @property
    def episodes(self) -> TensorDict:
        """The episodes of this split: ``episode`` (id), ``start`` (row) and ``length``, int64 [E] each."""
        position = self._episode_ids - 1
        columns = {EPISODE: self._episode_ids, "start": self.store.start[position]}
        columns["length"] = self.store.length[position]
        return TensorDict({key: torch.tensor(value) for key, value in columns.items()}, [len(position)])

    @property
    def num_steps(self) -> int:
        """Rows in this split."""
        return int(self.store.length[self._episode_ids - 1].sum())

    @property
    def num_frames(self) -> int:
        """T."""
        return self.storage.num_frames

    @property
    def frame_skip(self) -> int:
        """F."""
        return self.storage.frame_skip

    @property
    def action_dim(self) -> int:
        """A, the size of one raw action."""
        return self.statistics.action_dim

    def episode_data(
        self, episode: int, *, steps: slice = slice(None), keys: Sequence[str] = (PIXELS, ACTION, STATE)
    ) -> TensorDict:
        """One episode of this split, in environment units, and without a copy where the frames are raw.

        Args:
            episode (int): its id.

        Keyword Args:
            steps (slice, optional): the steps wanted, forwards. Default: all L.
            keys (sequence of str, optional): the columns wanted: compressed frames are decoded only on demand.
                Default: ``("pixels", "action", "state")``.

        Returns:
            [L]: ``keys``, ``episode``, ``step`` and ``("next", "done")``.

        Raises:
            KeyError: the split has no such episode.
        """
        position = np.searchsorted(self._episode_ids, episode)
        if position == len(self._episode_ids) or self._episode_ids[position] != episode:
            raise KeyError(f"the {self.split!r} split has no episode {episode}: choose one of dataset.episodes.")
        rows = self.store.rows(episode)
        length = rows.stop - rows.start
        self.store.check_files()
        step = torch.arange(length)[steps]
        rows = slice(*(rows.start + bound for bound in steps.indices(length)[:2]), steps.step)
        read = {key: self.store.frames if key == PIXELS else self.store.arrays[key].__getitem__ for key in keys}
        data = TensorDict({key: torch.from_numpy(get(rows)) for key, get in read.items()}, [len(step)])
        data[EPISODE], data[STEP] = torch.full_like(step, episode), step
        data[DONE] = (step == length - 1).unsqueeze(-1)  # [L, 1]
        return data

    # ------------------------------------------------------------------ position

    @property
    def batches(self) -> int:
        """Number of batches served so far; those that were prefetched and not served do not count."""
        return self._served

    @property
    def batches_per_epoch(self) -> int:
        """Number of batches that visit every clip once.

        Raises:
            RuntimeError: the dataset was made without a batch size.
        """
        if self.batch_size is None:
            raise RuntimeError("an epoch has a number of batches only if batch_size is given to the constructor.")
        return self.sampler.batches_per_epoch(len(self.storage), self.batch_size)

    def sample(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """The next batch; ``index`` holds the numbers of its clips. As TorchRL's ``sample``."""
        with prefetching_paused(self):
            batch = super().sample(*args, **kwargs)
            self._served += 1
        return batch

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields what is left of the current epoch, or a whole one if none has begun."""
        for _ in range(self.batches_per_epoch - self._served % self.batches_per_epoch):
            yield self.sample()

    def seek(self, batches: int) -> None:
        """Moves to a position: the next batch is batch number ``batches``, counted from 0.

        Args:
            batches (int): number of batches that count as served.

        Raises:
            ValueError: a negative number.
        """
        self._reposition(lambda: self.sampler.seek(batches))

    def state_dict(self) -> dict[str, int]:
        """The position, as plain numbers: neither the data nor prefetched batches are in it."""
        with locked(self):
            return {**self.sampler.state_dict(), "batches": self._served}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues at a saved position, with the saved seed.

        Args:
            state_dict (dict): what :meth:`state_dict` returned.

        Raises:
            ValueError: the position was saved with another batch size or another number of clips.
        """
        saved = (int(state_dict["num_clips"]), int(state_dict["batch_size"]))
        here = (len(self.storage), self.batch_size or saved[1])
        if any(saved) and saved != here:
            raise ValueError(
                f"the position was saved for {saved[0]} clips in batches of {saved[1]}, here are {here[0]} in batches "
                f"of {here[1]}: repeat the first settings, or begin again."
            )
        self._reposition(lambda: self.sampler.load_state_dict(state_dict))

    def _reposition(self, move: Callable[[], None]) -> None:
        with locked(self, discard=True):
            move()
            self._served = self.sampler.batches

    def dumps(self, path: str | Path) -> None:
        """Saves :meth:`state_dict` in a directory."""
        Path(path).mkdir(parents=True, exist_ok=True)
        write_atomic(Path(path) / _STATE_FILE, json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Loads what :meth:`dumps` saved."""
        self.load_state_dict(read_json(Path(path) / _STATE_FILE, "position"))

    def __getstate__(self) -> dict[str, Any]:
        # TorchRL copies the prefetched batches here. A spawned process would get them by file descriptors, which are
        # closed with the copies before the process has started; it draws these batches again.
        return {**super().__getstate__(), PREFETCHED: None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        use_one_reader(self)
        self.seek(self._served)

    # ------------------------------------------------------------------ TorchRL's interface of datasets

    @classproperty
    def available_datasets(cls) -> list[str]:  # noqa: N805
        """Names of the datasets under the default root."""
        return sorted(file.parent.name for file in Path(default_root("torchrl_ficreg")).glob(f"*/{META_FILE}"))

    @property
    def data_path(self) -> Path:
        """The directory of the dataset.

        Raises:
            RuntimeError: the dataset lives in memory.
        """
        if self.store.path is None:
            raise RuntimeError("a dataset made by from_episodes() lives in memory and has no path.")
        return self.store.path

    @property
    def data_path_root(self) -> Path:
        """The directory that holds the dataset's."""
        return self.data_path.parent

    def _is_downloaded(self) -> bool:
        return self.store.num_episodes >= self.store.header.target_episodes

    def preprocess(self, *args: Any, **kwargs: Any) -> None:
        """Refuses: clips are cut when read, so there are no rows to map."""
        raise RuntimeError("clips are cut when read: pass transform=, or write new episodes with EpisodeWriter.")

    def _resolve(self, dataset_id: str | Path | Sequence[str | Path]) -> Path | list[Path]:
        if not isinstance(dataset_id, (str, Path)):
            return [self._resolve(shard) for shard in dataset_id]
        path = Path(dataset_id).expanduser()
        return path if path.is_dir() or path.is_absolute() else Path(self.root) / path


def split_episodes(
    num_episodes: int, split: Split, *, fractions: tuple[float, float, float] = (0.8, 0.1, 0.1), seed: int = 0
) -> np.ndarray:
    """Ids of the episodes of a split.

    The split of episode e is decided by where ``frac(offset(seed) + e * 0.618...)`` lies among the cumulative fractions.
    It depends on nothing but e and the seed, so an episode never changes its split when the dataset grows; and because
    multiples of the golden ratio are evenly distributed, every prefix of a dataset has nearly the exact fractions.

    Args:
        num_episodes (int): episodes in the dataset, with ids 1 to ``num_episodes``.
        split (str): ``"train"``, ``"validation"``, ``"evaluation"`` or ``"all"``.

    Keyword Args:
        fractions (tuple of float, optional): of train, validation and evaluation; not negative, train positive,
            summing to 1. Default: ``(0.8, 0.1, 0.1)``.
        seed (int, optional): selects the offset. Default: ``0``.

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


def _make_sampler(sampler: ClipSampler | None, order: dict[str, Any], batch_size: int | None) -> ClipSampler:
    for name in sorted(order.keys() & _REFUSED.keys()):
        raise TypeError(f"OfflineTrajectories takes no {name}: {_REFUSED[name]}.")
    if sampler is None:
        return ClipSampler(**{**order, "drop_last": order.get("drop_last", True) and batch_size is not None})
    if order:
        raise TypeError(
            f"sampler= already sets the order, got {', '.join(sorted(order))} too: give them to the ClipSampler."
        )
    if not isinstance(sampler, ClipSampler):
        raise TypeError(
            f"only a ClipSampler can resume at a batch, got a {type(sampler).__name__}: to draw otherwise, build "
            "TensorDictReplayBuffer(storage=dataset.storage, sampler=...)."
        )
    return sampler


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
