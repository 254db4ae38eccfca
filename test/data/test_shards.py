"""Claim: shards recorded in parallel are the dataset that one writer would have recorded."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_ficreg.data import EpisodeStore, EpisodeWriter, OfflineTrajectories
from torchrl_ficreg.data.shards import open_store, shard_meta, shard_paths, ShardedStore

LENGTHS = [20, 31, 25, 40, 22, 28, 33]  # of episodes 1 to 7: shards of three, two and two


@pytest.fixture
def sharded(tmp_path, make_episode, meta) -> Callable[..., Path]:
    """``sharded(3)`` writes the episodes in turn into three shards and returns their folder."""

    def write(count: int, frames: str = "raw", shards: Sequence[int] | None = None, numbered: bool = True) -> Path:
        for shard in range(count) if shards is None else shards:
            mine = range(shard, len(LENGTHS), count)
            path = tmp_path / "dataset" / f"shard-{shard}"
            notes = {**meta, "shards": count, **({"shard": shard} if numbered else {})}
            settings = {"target_episodes": len(mine), "meta": notes, "frames": frames}
            with EpisodeWriter(path, **settings) as writer:
                for index in mine:
                    writer.append(make_episode(index + 1, LENGTHS[index]))
        return tmp_path / "dataset"

    return write


@pytest.fixture
def whole(record) -> Path:
    """The same episodes from one writer."""
    return record(LENGTHS)


@pytest.mark.parametrize("frames", ["raw", "png"])
def test_shards_are_the_dataset_of_one_writer(sharded, whole, frames):
    ours, theirs = open_store(sharded(3, frames)), EpisodeStore.open(whole)
    assert isinstance(ours, ShardedStore) and ours.fingerprint == theirs.fingerprint
    assert ours.start.tolist() == theirs.start.tolist() and ours.length.tolist() == theirs.length.tolist()
    for key in ("action", "state"):
        assert np.array_equal(ours.arrays[key], theirs.arrays[key])
    scattered = np.random.default_rng(0).integers(0, ours.num_steps, (5, 4))
    for rows in (scattered, slice(3, 9), slice(0, ours.num_steps, 7), slice(15, 25), slice(9, 3)):
        assert np.array_equal(ours.frames(rows), theirs.frames(rows))
    settings = {"num_frames": 3, "frame_skip": 4, "batch_size": 8, "keys": ("pixels", "action", "state", "episode")}
    ours, theirs = (OfflineTrajectories(store, **settings) for store in (ours, theirs))
    assert len(ours) == len(theirs) and torch.equal(ours.statistics.mean, theirs.statistics.mean)
    for _ in range(4):
        assert (ours.sample() == theirs.sample()).all()


def test_numbered_shards_may_be_listed_in_any_order_and_others_keep_that_of_the_list(sharded, whole, tmp_path):
    folder = sharded(3)
    ours = OfflineTrajectories([folder / "shard-2", folder / "shard-0", folder / "shard-1"], num_frames=2).store
    assert ours.fingerprint == EpisodeStore.open(whole).fingerprint
    assert "shard" not in ours.header.meta  # only what all shards have in common
    shutil.rmtree(folder)
    sharded(2, numbered=False)
    assert open_store([folder / "shard-1", folder / "shard-0"]).length.tolist()[:2] == [LENGTHS[1], LENGTHS[0]]
    assert open_store(folder).length.tolist() == LENGTHS


def test_a_list_of_sharded_folders_opens_all_their_shards(sharded, whole, tmp_path):
    """Two machines recorded two shards of four each."""
    folder = sharded(4)
    for number in (1, 3):
        (folder / f"shard-{number}").rename((tmp_path / f"shard-{number}"))
    assert open_store([tmp_path, folder]).fingerprint == EpisodeStore.open(whole).fingerprint


def test_what_is_no_dataset_of_shards_is_refused(sharded, record, tmp_path):
    folder, one, empty = sharded(2), record([20]), tmp_path / "empty"
    twice = "would be opened twice: list each once"
    for paths, message in (
        ([one, one], twice),
        ([folder, folder / "shard-1"], twice),
        ([one, one.parent / "x" / ".." / one.name], twice),
        ([folder / "shard-0", one], "shards must agree in their meta"),
        ([], "at least one directory"),
    ):
        with pytest.raises(ValueError, match=message):
            open_store(paths)
    shutil.copytree(folder / "shard-1", folder.parent / "copy")
    with pytest.raises(ValueError, match="shard 1 would be opened twice: give one of each"):
        open_store([folder, folder.parent / "copy"])
    for twin in ("shard-00", "shard-000"):
        shutil.copytree(one, folder / twin)
        for way in (shard_paths, open_store):
            with pytest.raises(ValueError, match=f"shard-0.*{twin}|{twin}.*shard-0"):
                way(folder)
        shutil.rmtree(folder / twin)
    shutil.rmtree(folder / "shard-0")
    with pytest.raises(ValueError, match="holds 1 of 2 shards: collect the rest"):
        OfflineTrajectories(folder)
    empty.mkdir()
    with pytest.raises(FileNotFoundError, match="no dataset at"):
        open_store(empty)


def test_shards_are_ordered_by_number_and_other_folders_beside_them_are_left_alone(sharded):
    folder = sharded(12, shards=range(len(LENGTHS)), numbered=False)
    (folder / "shard-6").rename(folder / "shard-10")
    for name in ("shard-1.bak", "shard-x", "shard-"):
        shutil.copytree(folder / "shard-1", folder / name)
    assert [path.name for path in shard_paths(folder)] == [f"shard-{number}" for number in (0, 1, 2, 3, 4, 5, 10)]
    assert open_store(folder, allow_incomplete=True).length.tolist() == LENGTHS


def test_the_first_shard_says_how_many_there_are(sharded, record, tmp_path):
    """Also one without an episode; a dataset that was not recorded as a shard is refused."""
    assert shard_meta(tmp_path) is None
    folder = sharded(3, shards=[1])
    (folder / "shard-1" / "episodes.jsonl").write_bytes(b"")
    assert shard_meta(folder)["shards"] == 3
    shutil.copytree(record([20]), tmp_path / "other" / "shard-0")
    with pytest.raises(ValueError, match="does not say how many shards"):
        shard_meta(tmp_path / "other")


def test_slices_are_not_copied_rows_are_checked_and_pickles_hold_paths(sharded):
    store = open_store(sharded(3))
    assert not store.frames(slice(22, 30)).flags.owndata
    for row in (-1, store.num_steps):
        with pytest.raises(IndexError, match="rows run from 0"):
            store.frames(np.array([row]))
    packed = pickle.dumps(store)
    assert np.array_equal(pickle.loads(packed).frames(np.arange(50)), store.frames(np.arange(50)))
    assert len(packed) < store.num_steps * 48  # the size of its frames alone
