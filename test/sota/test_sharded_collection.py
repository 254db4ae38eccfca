"""collect.py with a collector of TorchRL writes shards that every script opens as one dataset."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.shards import shard_paths

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


def drop_last_episode(folder: Path) -> None:
    """As a kill would leave it: the last line of an index was never written."""
    index = folder / "shard-1" / "episodes.jsonl"
    *kept, _ = index.read_bytes().splitlines(keepends=True)
    index.write_bytes(b"".join(kept))
