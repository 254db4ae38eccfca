"""collect.py with a collector of TorchRL writes shards that every script opens as one dataset."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
import pytest
from omegaconf import DictConfig

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.shards import open_store, shard_paths

SCRIPTS = Path(__file__).resolve().parents[2] / "sota-implementations" / "ficreg"
SMALL = ["env.data.episodes=7", "env.data.max_steps=30"]


def test_shards_are_continued_and_are_the_dataset_of_one_process(execute, tmp_path):
    sharded = [*SMALL, "collect.collector=async", "collect.num_workers=2", "data_dir=sharded"]
    done = execute(tmp_path, "collect.py", *sharded)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "sharded").iterdir()
    assert [path.name for path in shard_paths(folder)] == ["shard-0", "shard-1"]
    plain = execute(tmp_path, "collect.py", *SMALL, "data_dir=plain")
    assert plain.returncode == 0, plain.stderr
    (whole,) = (tmp_path / "plain").iterdir()
    settings = {"num_frames": 2, "frame_skip": 1, "split": "all"}
    expected = OfflineTrajectories(whole, **settings).fingerprint
    assert OfflineTrajectories(folder, **settings).fingerprint == expected

    drop_last_episode(folder)
    refused = execute(tmp_path, "collect.py", *SMALL, "data_dir=sharded")
    assert refused.returncode != 0 and "collect.collector=async, which continues them" in refused.stderr
    shutil.rmtree(folder / "shard-0")
    again = execute(tmp_path, "collect.py", *sharded)
    assert again.returncode == 0, again.stderr
    assert OfflineTrajectories(folder, **settings).fingerprint == expected


@pytest.fixture
def collect(monkeypatch, tmp_path) -> Callable[..., Path]:
    """``collect("collect.num_workers=2")`` records three short episodes; shards are recorded in this process."""
    monkeypatch.syspath_prepend(SCRIPTS)
    for name in ("episodes", "sharded"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    episodes, sharded = __import__("episodes"), __import__("sharded")

    def in_this_process(recorder, shares, **_):
        return ((shard, recorder(index)) for shard, share in enumerate(shares) for index in share)

    monkeypatch.setattr(sharded, "collect_shards", in_this_process)

    def settings(*overrides: str) -> DictConfig:
        small = ["env.data.episodes=3", "env.data.max_steps=5", "model.image_size=16", f"data_dir={tmp_path}"]
        with hydra.initialize_config_dir(str(SCRIPTS / "config"), version_base="1.3"):
            return hydra.compose("collect", [*small, "collect.collector=async", *overrides])

    yield lambda *overrides: episodes.collect_dataset(settings(*overrides))
    for name in ("episodes", "sharded"):
        del sys.modules[name]


@pytest.mark.parametrize(("workers", "shards"), [(0, 1), (2, 2), (9, 3)])
def test_there_are_as_many_shards_as_workers_but_for_none_and_too_many(collect, workers, shards):
    folder = collect(f"collect.num_workers={workers}")
    assert len(shard_paths(folder)) == shards and open_store(folder).num_episodes == 3


def test_a_recording_killed_before_the_first_episode_goes_on(collect):
    """Headers are written before the first index line: here there are headers, and no line at all."""
    folder = collect("collect.num_workers=2")
    fingerprint = open_store(folder).fingerprint
    for shard in shard_paths(folder):
        for file in (*shard.glob("*.memmap"), shard / "episodes.jsonl"):
            file.write_bytes(b"")
    assert open_store(collect("collect.num_workers=1")).fingerprint == fingerprint
    assert len(shard_paths(folder)) == 2


def test_shards_that_note_no_number_are_continued(collect):
    """As recorded before shards noted theirs."""
    folder = collect("collect.num_workers=2")
    fingerprint = open_store(folder).fingerprint
    for number, shard in enumerate(shard_paths(folder)):
        header = (shard / "meta.json").read_text()
        (shard / "meta.json").write_text(header.replace(f'    "shard": {number},\n', ""))
    drop_last_episode(folder)
    assert open_store(collect()).fingerprint == fingerprint


def test_a_dataset_of_one_piece_stays_one(collect):
    folder = collect("collect.collector=null", "collect.num_workers=0")
    assert collect() == folder and not shard_paths(folder)
    index = folder / "episodes.jsonl"
    index.write_bytes(b"".join(index.read_bytes().splitlines(keepends=True)[:-1]))
    with pytest.raises(ValueError, match="begun without a collector: leave out collect.collector"):
        collect()


def drop_last_episode(folder: Path) -> None:
    """As a kill would leave it: the last line of an index was never written."""
    index = folder / "shard-1" / "episodes.jsonl"
    *kept, _ = index.read_bytes().splitlines(keepends=True)
    index.write_bytes(b"".join(kept))
