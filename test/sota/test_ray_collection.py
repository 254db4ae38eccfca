"""collect.py with collect.ray records shards that every script opens as one dataset."""

from __future__ import annotations

import shutil

import pytest

from torchrl_ficreg.data import OfflineTrajectories
from torchrl_ficreg.data.shards import shard_paths

SMALL = ["env.data.episodes=7", "env.data.max_steps=30"]


@pytest.mark.slow
def test_shards_are_continued_and_are_the_dataset_of_one_process(execute, tmp_path):
    pytest.importorskip("ray", reason="pip install 'torchrl_ficreg[ray]'")
    folders = []
    for arguments in (["data_dir=plain"], ["data_dir=sharded", "collect.ray=2"]):
        done = execute(tmp_path, "collect.py", *SMALL, *arguments)
        assert done.returncode == 0, done.stderr
        folders += (tmp_path / arguments[0].removeprefix("data_dir=")).iterdir()
    settings = {"num_frames": 2, "frame_skip": 1, "split": "all"}
    whole, sharded = (OfflineTrajectories(folder, **settings).fingerprint for folder in folders)
    assert whole == sharded
    assert [path.name for path in shard_paths(folders[1])] == ["shard-0", "shard-1"]
    shutil.rmtree(folders[1] / "shard-0")
    again = execute(tmp_path, "collect.py", *SMALL, "data_dir=sharded")  # shards that exist are continued on Ray
    assert again.returncode == 0, again.stderr
    assert OfflineTrajectories(folders[1], **settings).fingerprint == whole
    index = folders[0] / "episodes.jsonl"
    index.write_bytes(b"".join(index.read_bytes().splitlines(keepends=True)[:-1]))
    refused = execute(tmp_path, "collect.py", *SMALL, "data_dir=plain", "collect.ray=2")
    assert refused.returncode != 0 and "begun without Ray: leave out collect.ray" in refused.stderr
