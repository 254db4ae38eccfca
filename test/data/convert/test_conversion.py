"""The conversion as a whole: what goes in is served, interruptions and memory do not matter, and nothing is mixed."""

from __future__ import annotations

import shutil
import tracemalloc
from collections import namedtuple

import numpy as np
import pytest
from foreign_files import write_lewm

from torchrl_ficreg.data import EpisodeStore, OfflineTrajectories
from torchrl_ficreg.data.convert import convert, from_arrays, open_source, TASKS
from torchrl_ficreg.data.writer import EpisodeWriter

FILES = ("meta.json", "episodes.jsonl", "pixels.memmap", "action.memmap", "state.memmap")


def content(path):
    return {name: (path / name).read_bytes() for name in FILES}


@pytest.fixture
def official(tmp_path, make_rows):
    """An official file of 20 episodes, and its rows."""
    rows = make_rows([24 + number % 5 for number in range(20)])
    return write_lewm(tmp_path / "official.h5", rows), rows


def test_a_converted_file_serves_the_rows_that_went_in(tmp_path, official):
    path, rows = official
    target = convert(path, tmp_path / "out", env="two_room", progress=False)
    dataset = OfflineTrajectories(
        target, split="all", num_frames=3, frame_skip=2, keys=("pixels", "action", "state", "episode", "step")
    )
    assert dataset.meta["env"] == "two_room"
    assert (dataset.meta["action_low"], dataset.meta["action_high"]) == ([-1, -1], [1, 1])
    assert dataset.meta["source"]["columns"] == {"pixels": ["pixels"], "action": ["action"], "state": ["state"]}
    assert len(dataset.episodes) == 20 and dataset.num_steps == len(rows["action"])
    offsets = rows["ep_len"].cumsum() - rows["ep_len"]
    clip = dataset[len(dataset) // 2]
    first = offsets[clip["episode"][0] - 1] + clip["step"][0]
    at = first + np.array([0, 2, 4])
    np.testing.assert_array_equal(clip["pixels"], rows["pixels"][at].transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(clip["state"], rows["state"][at])
    raw = dataset.statistics.denormalize(clip["action"])
    np.testing.assert_allclose(raw[0], rows["action"][first : first + 2].reshape(-1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("episodes", [0, 1, 7, 19])
def test_killed_and_repeated_it_ends_in_the_same_bytes(tmp_path, official, monkeypatch, episodes):
    path, _ = official
    unbroken = content(convert(path, tmp_path / "unbroken", progress=False))
    append = EpisodeWriter.append

    def die(self, episode):
        if self.num_episodes == episodes:
            raise KeyboardInterrupt
        return append(self, episode)

    monkeypatch.setattr(EpisodeWriter, "append", die)
    with pytest.raises(KeyboardInterrupt):
        convert(path, tmp_path / "killed", progress=False)
    monkeypatch.undo()
    read = []
    with open_source(path) as source:
        episode = source.episode
        monkeypatch.setattr(source, "episode", lambda index, size: read.append(index) or episode(index, size))
        assert content(convert(source, tmp_path / "killed", progress=False)) == unbroken
    assert read == list(range(episodes, 20))  # nothing is converted twice


def test_a_limit_takes_the_first_and_may_grow(tmp_path, official):
    path, _ = official
    whole = content(convert(path, tmp_path / "whole", progress=False))
    target = convert(path, tmp_path / "part", limit=5, progress=False)
    assert EpisodeStore.open(target).num_episodes == 5
    convert(path, tmp_path / "part", limit=500, progress=False)
    assert content(target) == whole
    convert(path, tmp_path / "part", progress=False)  # and again: nothing to do
    assert content(target) == whole


@pytest.mark.parametrize("kind", ["lewm", "ogbench", "lance", "lerobot"])
def test_memory_does_not_grow_with_the_file(tmp_path, write, make_rows, kind):
    """Twice as many episodes, 10 MB of frames more: the peak stays where it was, at a few episodes of 0.8 MB."""
    peaks = []
    for count in (12, 24):
        folder = tmp_path / str(count)
        folder.mkdir()
        rows = make_rows([66] * count, size=64, dims=4)
        path, episode = write[kind](folder, rows), rows["pixels"].nbytes // count
        del rows
        with open_source(path) as source:
            tracemalloc.start()
            convert(source, folder / "out", progress=False)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    assert max(peaks) < 10 * episode and peaks[1] < 1.3 * peaks[0]


def test_another_file_or_other_settings_do_not_continue_a_dataset(tmp_path, official, make_rows):
    path, rows = official
    convert(path, tmp_path / "out", limit=3, progress=False)
    with pytest.raises(ValueError, match="begun with image_size = 16, got 8"):
        convert(path, tmp_path / "out", image_size=8, progress=False)
    rows["action"] = rows["action"] * 1.01
    other = write_lewm(tmp_path / "other.h5", rows)
    shutil.move(other, path)
    with pytest.raises(ValueError, match="begun with "):
        convert(path, tmp_path / "out", progress=False)


def test_a_small_disk_is_noticed_before_anything_is_written(tmp_path, official, monkeypatch):
    """Compressed frames fit, and are those of the raw dataset."""
    path, _ = official
    usage, free = namedtuple("usage", "total used free"), [2**28 + 300_000]  # the reserve, and 0.3 MB
    monkeypatch.setattr(shutil, "disk_usage", lambda place: usage(2**40, 0, free[0]))
    with pytest.raises(OSError, match="needs 0.[0-9] MB and a reserve"):
        convert(path, tmp_path / "raw", progress=False)
    assert not (tmp_path / "raw" / "meta.json").exists()
    pytest.importorskip("PIL")
    png = convert(path, tmp_path / "png", frames="png", progress=False)
    free[0] *= 2
    raw = convert(path, tmp_path / "raw", progress=False)
    assert EpisodeStore.open(png).fingerprint == EpisodeStore.open(raw).fingerprint


def test_frames_are_scaled_by_area(tmp_path, official, expected):
    path, rows = official
    store = EpisodeStore.open(convert(path, tmp_path / "out", image_size=4, progress=False))
    assert store.header.shapes["pixels"] == (3, 4, 4) and store.header.meta["image_size"] == 4
    blocks = rows["pixels"].astype(float).reshape(-1, 4, 4, 4, 4, 3).mean((2, 4)).transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(store.arrays["pixels"], np.floor(blocks + 0.5))


def test_bounds_of_other_data_are_measured_or_given(tmp_path, official):
    path, rows = official
    measured = EpisodeStore.open(convert(path, tmp_path / "a", env="mine", limit=2, progress=False)).header.meta
    finite = rows["action"][np.isfinite(rows["action"]).all(1)].astype(float)
    assert measured["env"] == "mine"
    np.testing.assert_array_equal(measured["action_low"], finite.min(0))
    np.testing.assert_array_equal(measured["action_high"], finite.max(0))
    given = convert(path, tmp_path / "b", action_bounds=([-2, -2], [3, 3]), progress=False)
    assert EpisodeStore.open(given).header.meta["action_high"] == [3, 3]
    with pytest.raises(ValueError, match="two vectors of 2 numbers"):
        convert(path, tmp_path / "c", action_bounds=([-1], [1]), progress=False)


@pytest.mark.parametrize(
    ("settings", "message"),
    [(wrong, "must be") for wrong in ({"limit": 0}, {"image_size": 0}, {"frames": "jpeg"})]
    + [({"env": "two_room"}, "pass env= to open_source")],
)
def test_wrong_arguments_are_refused_before_anything_is_written(tmp_path, make_rows, settings, message):
    rows = make_rows([30, 30])
    source = from_arrays(**{key: rows[key] for key in ("pixels", "action", "state")}, lengths=[30, 30])
    with pytest.raises(ValueError, match=message):
        convert(source, tmp_path / "out", progress=False, **settings)
    assert not (tmp_path / "out").exists()


def test_the_table_of_states_is_that_of_the_environments():
    pytest.importorskip("pymunk")
    from torchrl_ficreg.envs import make_env
    from torchrl_ficreg.envs.registry import ENVIRONMENTS

    for name in TASKS.keys() & ENVIRONMENTS.keys():
        try:
            env = make_env(name)
        except (ImportError, OSError, RuntimeError) as error:
            pytest.skip(f"{name} cannot be built here: {error}")
        assert env.observation_spec["state"].shape[-1] == TASKS[name].state_dim
        space = env.full_action_spec_unbatched["action"].space
        assert space.low.tolist() == [-1] * TASKS[name].action_dim and (space.high == 1).all()
        env.close()
