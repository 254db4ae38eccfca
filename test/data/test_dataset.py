"""The dataset as a whole: exact resumption, statistics of training episodes only, splits, and TorchRL's conventions."""

from __future__ import annotations

import hashlib
import multiprocessing
import pickle
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from torchrl.checkpoint import Checkpoint
from torchrl.data import RandomSampler
from torchrl.data.datasets import load_dataset

from torchrl_ficreg.data import (
    ActionStatistics,
    ClipSampler,
    ClipStorage,
    EpisodeStore,
    OfflineTrajectories,
    split_episodes,
)

LENGTHS = [20 + number % 7 for number in range(30)]


@pytest.fixture(scope="module")
def path(record):
    return record(LENGTHS)


def indices(dataset, count):
    return [dataset.sample()["index"][:, 0].tolist() for _ in range(count)]


def test_a_batch_has_the_contracted_shapes(path):
    batch = OfflineTrajectories(path, batch_size=8, keys=("pixels", "action", "state", "episode", "step")).sample()
    assert batch.batch_size == (8, 4)
    shapes = {key: (tuple(value.shape), value.dtype) for key, value in batch.items()}
    assert shapes == {
        "pixels": ((8, 4, 3, 4, 4), torch.uint8),
        "action": ((8, 4, 15), torch.float32),
        "mask": ((8, 4), torch.bool),
        "state": ((8, 4, 2), torch.float64),
        "episode": ((8, 4), torch.int64),
        "step": ((8, 4), torch.int64),
        "index": ((8, 4), torch.int64),
    }
    assert OfflineTrajectories(path, num_frames=2, frame_skip=3).sample(5)["action"].shape == (5, 2, 9)


@pytest.mark.parametrize("prefetch", [None, 1, 3])
def test_iterating_yields_exact_epochs(path, prefetch):
    dataset = OfflineTrajectories(path, batch_size=7, prefetch=prefetch, drop_last=False)
    for _ in range(3):
        order = torch.cat([batch["index"][:, 0] for batch in dataset]).tolist()
        assert sorted(order) == list(range(len(dataset)))
    for batch in dataset:
        break
    assert sum(1 for _ in dataset) == dataset.batches_per_epoch - 1  # what is left of it
    assert dataset.batches == 4 * dataset.batches_per_epoch
    with pytest.raises(RuntimeError, match="batch_size"):
        OfflineTrajectories(path).batches_per_epoch


@pytest.mark.parametrize("saving", [None, 1, 4])
@pytest.mark.parametrize("resuming", [None, 1, 4])
def test_a_run_resumes_at_the_exact_batch(path, saving, resuming):
    unbroken = indices(OfflineTrajectories(path, batch_size=7, seed=5), 60)
    dataset = OfflineTrajectories(path, batch_size=7, seed=5, prefetch=saving)
    assert indices(dataset, 25) == unbroken[:25]
    state = dataset.state_dict()
    indices(dataset, 3)  # going on does not change what was saved
    resumed = OfflineTrajectories(path, batch_size=7, seed=77, prefetch=resuming)
    indices(resumed, 2)  # nor does what was prefetched before loading leak in
    resumed.load_state_dict(state)
    assert resumed.batches == 25 and indices(resumed, 35) == unbroken[25:]
    resumed.seek(11)
    assert indices(resumed, 5) == unbroken[11:16]


def test_checkpoints_hold_the_position_and_not_the_data(path, tmp_path):
    dataset = OfflineTrajectories(path, batch_size=7, prefetch=2)
    indices(dataset, 9)
    assert len(pickle.dumps(dataset.state_dict())) < 300
    dataset.dumps(tmp_path / "own")
    Checkpoint(data=dataset).save(tmp_path / "torchrl")
    assert sum(file.stat().st_size for file in (tmp_path / "torchrl").rglob("*") if file.is_file()) < 20_000
    expected = indices(dataset, 4)
    for load in (lambda fresh: fresh.loads(tmp_path / "own"), lambda fresh: Checkpoint(data=fresh).load(tmp_path / "torchrl")):
        fresh = OfflineTrajectories(path, batch_size=7, prefetch=2)
        load(fresh)
        assert indices(fresh, 4) == expected


def test_a_position_of_another_dataset_is_refused(path):
    dataset = OfflineTrajectories(path, batch_size=7)
    dataset.sample()
    with pytest.raises(ValueError, match="in batches of 7, here are .* in batches of 8"):
        OfflineTrajectories(path, batch_size=8).load_state_dict(dataset.state_dict())
    with pytest.raises(ValueError, match="saved for"):
        OfflineTrajectories(path, batch_size=7, split="all").load_state_dict(dataset.state_dict())


def test_a_position_of_the_first_layout_is_continued(tmp_path):
    """Dataset and position as they were written before the package was laid out anew; the batches as they were then."""
    pytest.importorskip("PIL", reason="its frames are compressed")
    with ZipFile(Path(__file__).parents[1] / "golden" / "first_layout.zip") as archive:
        archive.extractall(tmp_path, [name for name in archive.namelist() if name.startswith("data/")])
    dataset = OfflineTrajectories(next((tmp_path / "data").iterdir()), 32, num_frames=2, prefetch=1)
    saved = {"seed": 0, "shuffle": 1, "drop_last": 1, "batches": 56, "batch_size": 32, "num_clips": 901}
    dataset.load_state_dict(saved)
    digest = hashlib.sha256()
    for batch in (dataset.sample() for _ in range(4)):
        for key in ("pixels", "index"):
            digest.update(batch[key].numpy().tobytes())
    assert digest.hexdigest()[:16] == "22f450e48eafb488" and dataset.state_dict() == {**saved, "batches": 60}


def test_statistics_come_from_training_episodes_only(path, make_episode):
    train = split_episodes(30, "train")
    actions = np.concatenate([make_episode(e, LENGTHS[e - 1])["action"][:-1] for e in train])  # not the last rows
    for split in ("train", "validation", "evaluation", "all"):
        dataset = OfflineTrajectories(path, split=split, batch_size=7)
        np.testing.assert_allclose(dataset.statistics.mean, actions.mean(0, dtype=float), rtol=1e-6)
        np.testing.assert_allclose(dataset.statistics.std, actions.std(0, dtype=float), rtol=1e-6)
        batch = dataset.sample()
        raw = ClipStorage(dataset.store, dataset.episodes["episode"], num_frames=4, frame_skip=5)[batch["index"][:, 0]]
        expected = torch.where(batch["mask"][..., None], dataset.statistics.normalize(raw["action"]), torch.zeros(()))
        assert batch["action"].equal(expected) and not batch["mask"].all()
    with pytest.raises(ValueError, match="training split is empty"):
        OfflineTrajectories.from_episodes([make_episode(1)], split_fractions=(0.001, 0.0, 0.999), split="evaluation")


def test_given_statistics_are_used(path):
    identity = ActionStatistics(torch.zeros(3), torch.ones(3))
    batch = OfflineTrajectories(path, batch_size=7, statistics=identity, keys=("action", "step")).sample()
    assert batch["action"][:, 0, 1].equal(batch["step"][:, 0].float())


def test_splits_share_one_mapping_and_no_episode(path):
    store, served = EpisodeStore.open(path), {}
    for split in ("train", "validation", "evaluation"):
        dataset = OfflineTrajectories(store, split=split, batch_size=1, keys=("episode",))
        assert dataset.store is store and dataset.data_path == path
        served[split] = {episode for batch in dataset for episode in batch["episode"].flatten().tolist()}
        assert served[split] == set(dataset.episodes["episode"].tolist())
    assert set.union(*served.values()) == set(range(1, 31)) and sum(map(len, served.values())) == 30
    assert indices(OfflineTrajectories(store, batch_size=7), 3) == indices(OfflineTrajectories(path, batch_size=7), 3)


def test_rows_and_whole_episodes(path, make_episode):
    dataset = OfflineTrajectories(path, split="evaluation", batch_size=1)
    assert dataset.num_steps == sum(dataset.episodes["length"].tolist())
    assert len(dataset) == sum(length - 15 for length in dataset.episodes["length"].tolist())
    for number, start, length in zip(*(dataset.episodes[key].tolist() for key in ("episode", "start", "length"))):
        assert dataset.store.rows(number) == slice(start, start + length)
        data, want = dataset.episode_data(number), make_episode(number, LENGTHS[number - 1])
        assert data.shape == (length,)
        for key, value in want.items():
            np.testing.assert_array_equal(data[key], value)
        assert data["next", "done"].squeeze(-1).nonzero().tolist() == [[length - 1]]
        assert data["step"].tolist() == list(range(length)) and set(data["episode"].tolist()) == {number}
    absent = OfflineTrajectories(path).episodes["episode"][0].item()
    with pytest.raises(KeyError, match=f"'evaluation' split has no episode {absent}"):
        dataset.episode_data(absent)


def test_it_is_read_only(path):
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    dataset = OfflineTrajectories(path, batch_size=7)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        dataset.extend(dataset[:2])
    with pytest.raises(RuntimeError, match="cannot be changed"):
        dataset[0] = dataset[1]
    with pytest.raises(RuntimeError):
        dataset.empty()
    with pytest.raises(RuntimeError, match="pass transform="):
        dataset.preprocess(lambda data: data, dest=path)
    dataset.sample().zero_()
    dataset.episode_data(1).zero_()
    dataset.meta.clear()
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before
    assert dataset.meta["env"] == "two_room"


def test_torchrl_finds_it(path):
    dataset = load_dataset(f"ficreg:{path}", batch_size=7, split="all")
    assert isinstance(dataset, OfflineTrajectories) and dataset.data_path == path
    named = OfflineTrajectories(path.name, root=path.parent, batch_size=7, split="all")
    assert named.fingerprint == dataset.fingerprint and named.data_path_root == path.parent
    assert indices(named, 3) == indices(dataset, 3)
    with pytest.raises(FileNotFoundError, match="collect.py"):
        OfflineTrajectories("no_such_dataset", root=path.parent)
    assert isinstance(OfflineTrajectories.available_datasets, list)
    assert "OfflineTrajectories" in repr(dataset) and dataset.can_sample() and dataset.stats()


def test_memory_and_disk_serve_the_same(path, make_episode, meta):
    """With and without prefetching; writing into a batch reaches neither of them."""
    episodes = [make_episode(number, length) for number, length in enumerate(LENGTHS, 1)]
    disk = OfflineTrajectories(path, batch_size=7)
    memory = OfflineTrajectories.from_episodes(episodes, meta=meta, batch_size=7, prefetch=2)
    for _ in range(2 * disk.batches_per_epoch):
        ours, theirs = disk.sample(), memory.sample()
        assert (ours == theirs).all()
        ours.zero_(), theirs.zero_()
    assert disk.fingerprint == memory.fingerprint and disk.meta == memory.meta
    assert (pickle.loads(pickle.dumps(memory)).episode_data(1) == disk.episode_data(1)).all()
    with pytest.raises(RuntimeError, match="lives in memory"):
        memory.data_path


def _next_batches(datasets):
    return [(indices(dataset, 3), {key: value.sum().item() for key, value in dataset.sample().items()}) for dataset in datasets]


def test_it_continues_in_a_spawned_worker(path, record):
    """With and without prefetching, with raw and with compressed frames, after threads have read them here."""
    pytest.importorskip("PIL", reason="compressed frames need Pillow")
    packed = record(LENGTHS, frames="webp")
    datasets = [OfflineTrajectories(place, 7, prefetch=prefetch) for place, prefetch in ((path, None), (path, 2), (packed, 2))]
    for dataset in datasets:
        indices(dataset, 2)
    with multiprocessing.get_context("forkserver").Pool(1) as pool:  # pickled as for a spawned one, which starts slowly
        arrived = pool.apply_async(_next_batches, (datasets,)).get(timeout=120)
    assert arrived == _next_batches(datasets)


@pytest.mark.parametrize("prefetch", [None, 2])
def test_pickling_carries_no_data(record, prefetch):
    """Neither the dataset's nor that of prefetched batches, which are drawn again; the number of threads stays."""
    store = EpisodeStore.open(record([200] * 12), num_threads=2)
    dataset = OfflineTrajectories(store, batch_size=7, prefetch=prefetch)
    dataset.sample()
    assert len(pickle.dumps(dataset)) < 30_000 < dataset.store.arrays["pixels"].nbytes
    arrived = pickle.loads(pickle.dumps(dataset))
    assert indices(arrived, 2) == indices(dataset, 2) and arrived.store.num_threads == 2


@pytest.mark.parametrize(
    ("error", "settings", "message"),
    [
        (TypeError, {"sampler": RandomSampler()}, "only a ClipSampler can resume at a batch, got a RandomSampler"),
        (TypeError, {"sampler": ClipSampler(), "seed": 1}, "sampler= already sets the order, got seed too"),
        (TypeError, {"writer": None}, "takes no writer: .* EpisodeWriter"),
        (TypeError, {"split_trajs": True}, "takes no split_trajs: .* episode_data"),
        (TypeError, {"download": True}, "takes no download: .* collect_episodes"),
        (TypeError, {"sufle": True}, "unexpected keyword argument 'sufle'"),
        (ValueError, {"batch_size": 5000}, "'train' split holds .* clips, less than one batch of 5000"),
        (ValueError, {"split": "test"}, "split must be one of"),
        (ValueError, {"statistics": ActionStatistics(torch.zeros(2), torch.ones(2))}, "describe 2 action dimensions, .* has 3"),
    ],
)
def test_arguments_that_a_dataset_of_clips_cannot_have_are_refused(path, error, settings, message):
    with pytest.raises(error, match=message):
        OfflineTrajectories(path, **{"batch_size": 7, **settings})


def test_a_sampler_a_transform_and_a_collate_fn_can_be_given(path):
    given = {"transform": lambda clip: clip.set("action", clip["action"] / 2)}
    given["collate_fn"] = lambda clips: clips.exclude("mask")
    sampler = ClipSampler(seed=5, shuffle=True)
    dataset, plain = OfflineTrajectories(path, 7, sampler=sampler, **given), OfflineTrajectories(path, 7, seed=5)
    ours, theirs = dataset.sample(), plain.sample()
    assert dataset.sampler is sampler and "mask" not in ours.keys() and (ours["action"] * 2).equal(theirs["action"])
    assert indices(dataset, 3) == indices(plain, 3)


def test_pinning_is_harmless_without_an_accelerator(path):
    batch = OfflineTrajectories(path, batch_size=7, pin_memory=True).sample()
    assert batch["pixels"].is_pinned() == torch.cuda.is_available()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("prefetch", [None, 2])
def test_pinned_clips_reach_the_device_unchanged(path, prefetch):
    pinned = OfflineTrajectories(path, batch_size=7, pin_memory=True, prefetch=prefetch)
    plain = OfflineTrajectories(path, batch_size=7)
    for _ in range(5):
        batch = pinned.sample()
        assert batch["pixels"].is_pinned()
        assert (batch.to("cuda", non_blocking=True).cpu() == plain.sample()).all()
