"""Several dataset directories opened as one dataset, as several processes or machines recorded them.

::

    <dataset>/
      shard-0/           episodes 1, 4, 7, ...    each shard a dataset of its own, made by one EpisodeWriter
      shard-1/           episodes 2, 5, 8, ...
      shard-2/           episodes 3, 6, 9, ...
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg.data.layout import Header, IndexEntry, META_FILE, read_header, read_index
from torchrl_ficreg.data.store import EpisodeStore, Verify
from torchrl_ficreg.keys import PIXELS

SHARD = "shard-{}"
# Fields of a shard's meta: its number, from 0, and the number of all shards.
SHARD_NUMBER, NUM_SHARDS = "shard", "shards"


def open_store(
    path: str | Path | Sequence[str | Path],
    *,
    allow_incomplete: bool = False,
    verify: Verify = "ends",
    num_threads: int | None = None,
) -> EpisodeStore:
    """Opens a dataset directory, a directory of shards, or a list of directories.

    Args:
        path (str, Path or sequence of them): one of the three. In a list, a directory of shards stands for all of them.
            Episodes are numbered by the numbers that the shards have in their meta, otherwise by the order of the list,
            which then decides the split.

    Keyword Args:
        allow_incomplete (bool, optional): accept fewer episodes, or shards, than the target. Default: ``False``.
        verify (str, optional): which checksums of each shard to compare: ``"ends"``, those of the first and last
            episode, ``"full"``, all, or ``"none"``. Default: ``"ends"``.
        num_threads (int, optional): threads that copy or decode frames. Default: the usable cores, at most eight.

    Returns:
        the episodes, for :class:`~torchrl_ficreg.data.OfflineTrajectories`.

    Raises:
        FileNotFoundError: there is no dataset.
        ValueError: one is damaged, incomplete or listed twice, or they differ in frame format, row shapes or meta.
    """
    options = {"allow_incomplete": allow_incomplete, "verify": verify, "num_threads": num_threads}
    folder = Path(path) if isinstance(path, (str, Path)) else None
    paths = [part for whole in ([folder] if folder else path) for part in _parts(Path(whole))]
    if not paths:
        raise ValueError("a dataset needs at least one directory, got an empty list.")
    _refuse_twice([part.resolve() for part in paths], "list each once")
    if paths == [folder]:
        return EpisodeStore.open(folder, **options)
    store = ShardedStore([EpisodeStore.open(shard, **options) for shard in paths], folder)
    want = store.header.meta.get(NUM_SHARDS, len(paths))
    if len(paths) != want and not allow_incomplete:
        raise ValueError(f"{path} holds {len(paths)} of {want} shards: collect the rest, or pass allow_incomplete=True.")
    return store


def shard_paths(folder: Path) -> list[Path]:
    """The shards of a directory that have a header, by number.

    Raises:
        ValueError: two have the same number, such as ``shard-0`` and ``shard-00``.
    """
    found = [path.parent for path in folder.glob(f"{SHARD.format('*')}/{META_FILE}")]
    found = sorted(path for path in found if re.fullmatch(r"shard-[0-9]+", path.name))
    numbered = {int(path.name.rpartition("-")[2]): path for path in found}
    if len(numbered) < len(found):
        first = next(path for path in found if path not in numbered.values())
        twin = numbered[int(first.name.rpartition("-")[2])].name
        raise ValueError(f"{folder} holds {first.name} and {twin}, two shards of one number: move one of them away.")
    return [path for _, path in sorted(numbered.items())]


def shard_meta(folder: Path) -> dict[str, Any] | None:
    """The meta of the first shard of a directory, which may hold no episode yet; None where there is no shard.

    Raises:
        ValueError: the shard was not recorded as one.
    """
    for path in shard_paths(folder):
        file = path / META_FILE
        meta = read_header(path).meta
        if NUM_SHARDS not in meta:
            raise ValueError(f"{file} does not say how many shards exist: give dataset={folder} or another data_dir.")
        return meta
    return None


class ShardedStore(EpisodeStore):
    """The episodes of several stores, one of each in turn, as if they had been recorded in that order.

    If process w of W records the episodes w, w + W, w + 2 W, ..., the result is the dataset that one process would
    record: same episode ids, hence same splits and clips, and same fingerprint. Actions and states are copied into
    memory; frames stay in the shards.

    Args:
        shards (sequence of EpisodeStore): opened stores; sorted by the numbers in their meta where each has one.
        path (Path, optional): the directory that holds them, where frozen start-goal pairs are stored.
            Default: ``None``.

    Raises:
        ValueError: the shards differ in frame format, row shapes or meta, or two have the same number.
    """

    def __init__(self, shards: Sequence[EpisodeStore], path: Path | None = None) -> None:
        numbers = [shard.header.meta.get(SHARD_NUMBER) for shard in shards]
        headers = [_without_number(shard.header) for shard in shards]
        first = headers[0]
        for shard, header in zip(shards[1:], headers[1:]):
            for name in ("frames", "shapes", "meta"):
                ours, theirs = getattr(first, name), getattr(header, name)
                if ours != theirs:
                    raise ValueError(
                        f"shards must agree in their {name}: {shards[0].path} has {ours}, {shard.path} has {theirs}. "
                        "Open them as datasets of their own."
                    )
        if None not in numbers:
            _refuse_twice([f"shard {number}" for number in numbers], "give one of each")
            shards = [shard for _, shard in sorted(zip(numbers, shards), key=lambda pair: pair[0])]
        self.shards = list(shards)
        # Stable: by place within the shard, then by shard.
        turns = sorted((place, number) for number, shard in enumerate(shards) for place in range(shard.num_episodes))
        self._shard = np.array([number for _, number in turns])  # [E]
        self._first = np.array([shards[number].start[place] for place, number in turns])  # [E], row within the shard
        entries, row = [], 0
        indices = [_index(shard) for shard in shards]
        for episode, (place, number) in enumerate(turns, start=1):
            entries.append(indices[number][place]._replace(episode=episode, start=row))
            row = entries[-1].stop
        header = replace(first, target_episodes=sum(shard.header.target_episodes for shard in shards))
        super().__init__(header, entries, None, path)

    def frames(self, rows: slice | np.ndarray) -> np.ndarray:
        """As :meth:`EpisodeStore.frames`; a slice is not copied where it lies within one episode."""
        if isinstance(rows, slice):
            start, stop, step = rows.indices(self.num_steps)
            inside = step > 0 and start < stop
            episode = self._episode_of(np.array(start)) if inside else 0
            if inside and stop <= self.start[episode] + self.length[episode]:
                shift = self._first[episode] - self.start[episode]
                return self.shards[self._shard[episode]].frames(slice(start + shift, stop + shift, step))
            rows = np.arange(start, stop, step)
        flat = np.asarray(rows).reshape(-1)  # [N]
        if flat.size and (flat.min() < 0 or flat.max() >= self.num_steps):
            raise IndexError(f"rows run from 0 to {self.num_steps - 1}, got {flat.min()} to {flat.max()}.")
        episode = self._episode_of(flat)
        local = self._first[episode] + flat - self.start[episode]
        out = np.empty((len(flat), *self.header.shapes[PIXELS]), np.uint8)
        for number in np.unique(self._shard[episode]):
            mine = self._shard[episode] == number
            out[mine] = self.shards[number].frames(local[mine])
        return out.reshape(*np.shape(rows), *out.shape[1:])

    def _episode_of(self, rows: np.ndarray) -> np.ndarray:
        """Position, from 0, of the episode that holds each row."""
        return np.searchsorted(self.start, rows, side="right") - 1

    def check_files(self) -> None:
        """As :meth:`EpisodeStore.check_files`, of every shard."""
        for shard in self.shards:
            shard.check_files()

    def _open_data(self) -> None:
        keys = [key for key in self.header.mapped if key != PIXELS]
        self.arrays = {key: np.concatenate([self._rows_of(e)[key] for e in range(self.num_episodes)]) for key in keys}

    def _rows_of(self, episode: int) -> dict[str, np.ndarray]:
        span = slice(self._first[episode], self._first[episode] + self.length[episode])
        return {key: rows[span] for key, rows in self.shards[self._shard[episode]].arrays.items() if key != PIXELS}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "arrays": None}


def _parts(folder: Path) -> list[Path]:
    """The datasets of a directory: its shards, or itself."""
    return [folder] if (folder / META_FILE).exists() else shard_paths(folder) or [folder]


def _without_number(header: Header) -> Header:
    """The header of a shard without its number: equal for all shards."""
    return replace(header, meta={key: value for key, value in header.meta.items() if key != SHARD_NUMBER})


def _refuse_twice(names: Sequence[object], advice: str) -> None:
    twice = [str(name) for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"{', '.join(twice)} would be opened twice: {advice}.")


def _index(shard: EpisodeStore) -> list[IndexEntry]:
    """The index of a shard, read again because a store does not keep its checksums."""
    return read_index(shard.path, shard.header)[0][: shard.num_episodes]
