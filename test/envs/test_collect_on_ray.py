"""Shards recorded by Ray tasks are the dataset that one process records, and are continued after interruptions."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from types import SimpleNamespace

import pytest

from torchrl_ficreg.data import EpisodeStore, EpisodeWriter
from torchrl_ficreg.data.shards import open_store, shard_paths
from torchrl_ficreg.envs import collect_episodes, collect_on_ray

COUNT = 7
SETTINGS = {"seed": 3, "image_size": 16, "max_steps": 60, "expert_kwargs": {"noise_std": 0.5}}  # lengths differ


class RayError(Exception):
    cause = OSError("disk full\nat line 1")


class Task:
    def __init__(self, function, arguments):
        self.function, self.arguments, self.shard = function, arguments, arguments[0].name


class SerialRay:
    """The part of Ray that is used, which executes a task in this process when its result is asked for."""

    exceptions = SimpleNamespace(RayError=RayError)

    def __init__(self):
        self.executed, self.cancelled, self.failing, self.running = [], [], None, False

    def is_initialized(self):
        return self.running

    def init(self):
        self.running = True
        return self

    def shutdown(self):
        self.running = False

    def remote(self, **options):
        return lambda function: SimpleNamespace(remote=lambda *arguments: Task(function, arguments))

    def wait(self, tasks):
        return tasks[:1], tasks[1:]

    def get(self, task):
        if task.shard == self.failing:
            raise RayError("a report of many lines")
        self.executed.append(task.shard)
        return task.function(*task.arguments)

    def cancel(self, task, force):
        self.cancelled.append(task.shard)


@pytest.fixture
def ray(monkeypatch):
    stand_in = SerialRay()
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    return stand_in


@pytest.fixture(scope="module")
def fingerprint():
    """Of the same episodes, recorded in one process."""
    return EpisodeStore.from_episodes(list(collect_episodes("two_room", COUNT, num_workers=0, **SETTINGS))).fingerprint


def record(folder, num_tasks=3, **changes):
    return collect_on_ray(folder, "two_room", COUNT, num_tasks=num_tasks, **{**SETTINGS, **changes})


def drop_last_episode(shard):
    """As a kill would leave it: the last line of the index was never written."""
    *kept, _ = (shard / "episodes.jsonl").read_bytes().splitlines(keepends=True)
    (shard / "episodes.jsonl").write_bytes(b"".join(kept))


@pytest.mark.parametrize(("num_tasks", "shards"), [(1, 1), (3, 3), (9, COUNT)])
def test_any_number_of_tasks_records_the_same_dataset(ray, fingerprint, tmp_path, num_tasks, shards):
    folder = record(tmp_path, num_tasks)
    assert len(shard_paths(folder)) == shards == len(ray.executed)
    assert open_store(folder).fingerprint == fingerprint
    assert not ray.running  # the session that it started


def test_finished_shards_are_skipped_and_others_continued(ray, fingerprint, tmp_path):
    """Also those killed before their first index line, and those written before shards noted their numbers."""
    folder = record(tmp_path)
    ray.executed.clear()
    assert record(tmp_path, num_tasks=5) == folder and not ray.executed
    drop_last_episode(folder / "shard-1")
    shutil.rmtree(folder / "shard-2")
    record(tmp_path, num_tasks=5)  # the number of shards stays
    assert ray.executed == ["shard-1", "shard-2"] and open_store(folder).fingerprint == fingerprint
    for shard in shard_paths(folder):
        for file in (*shard.glob("*.memmap"), shard / "episodes.jsonl"):
            file.write_bytes(b"")
    assert open_store(record(tmp_path)).fingerprint == fingerprint
    for number, shard in enumerate(shard_paths(folder)):
        header = (shard / "meta.json").read_text()
        (shard / "meta.json").write_text(header.replace(f'    "shard": {number},\n', ""))
    drop_last_episode(folder / "shard-1")
    assert open_store(record(tmp_path)).fingerprint == fingerprint


def test_a_task_that_fails_is_one_line_and_cancels_the_rest(ray, tmp_path):
    ray.failing = "shard-1"
    with pytest.raises(RuntimeError, match=r"shard-1 failed \(OSError: disk full\): the episodes before are kept") as caught:
        record(tmp_path)
    assert "\n" not in str(caught.value) and ray.cancelled == ["shard-2"] and not ray.running
    ray.failing = None
    assert open_store(record(tmp_path)).num_episodes == COUNT


def test_other_settings_and_other_folders_are_refused(ray, tmp_path):
    record(tmp_path / "shards")
    with pytest.raises(ValueError, match="seed"):
        record(tmp_path / "shards", seed=4)
    next_episode = next(collect_episodes("two_room", 1, num_workers=0, **SETTINGS))
    with EpisodeWriter(tmp_path / "plain", target_episodes=1, meta={}) as writer:
        writer.append(next_episode)
    with pytest.raises(ValueError, match="holds a dataset without shards"):
        record(tmp_path / "plain")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "shard-1").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="shard-1 is a link"):
        record(tmp_path / "linked")
    assert not any((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"num_tasks": 0}, "num_tasks and num_episodes must be at least 1, got 0"), ({"max_steps": 0}, "max_steps must be")],
)
def test_bad_arguments_are_refused_before_anything_is_written(ray, tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        record(tmp_path / "new", **changes)
    assert not (tmp_path / "new").exists()


def test_a_missing_package_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl_ficreg\[ray\]'"):
        record(tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="pip install 'torchrl_ficreg[ray]'")
def test_ray_itself_records_on_two_workers(fingerprint, tmp_path):
    import ray

    ray.init(num_cpus=2, include_dashboard=False)
    try:
        folder = record(tmp_path)
        assert open_store(folder).fingerprint == fingerprint
        shutil.rmtree(folder / "shard-2")
        drop_last_episode(folder / "shard-1")
        assert open_store(record(tmp_path)).fingerprint == fingerprint
        with pytest.raises(RuntimeError, match="shard-. failed .*noise_std must be finite") as caught:
            record(tmp_path / "bad", expert_kwargs={"noise_std": -1.0})
        assert "\n" not in str(caught.value)
    finally:
        ray.shutdown()
