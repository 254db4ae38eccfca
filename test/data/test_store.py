"""Datasets open as they were written, or are refused in one line; what is written into the arrays never reaches the files."""

from __future__ import annotations

import json
import os

import pytest

from torchrl_ficreg.data import EpisodeStore
from torchrl_ficreg.data.layout import Header, INDEX_FILE, IndexEntry, write_header


@pytest.mark.parametrize("key", ["pixels", "action", "state"])
def test_a_damaged_data_file_is_reported(record, key):
    path = record([20, 21, 22])
    file = path / f"{key}.memmap"
    whole = file.read_bytes()
    row = len(whole) // 63
    for episode, at in [(1, 3 * row), (2, 25 * row), (3, 62 * row)]:
        damaged = bytearray(whole)
        damaged[at] ^= 1
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"bytes of episode {episode} do not match"):
            EpisodeStore.open(path, verify="full")
        if episode != 2:  # the default is cheap: it looks at both ends
            with pytest.raises(ValueError, match=f"bytes of episode {episode} do not match"):
                EpisodeStore.open(path)
        EpisodeStore.open(path, verify="none" if episode != 2 else "ends")
    for break_it in (lambda: file.write_bytes(whole[:-1]), file.unlink):
        break_it()
        with pytest.raises(ValueError, match=f"{key}.memmap is damaged"):
            EpisodeStore.open(path, verify="none")


def test_absent_and_incomplete_datasets_name_the_command(record, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"collect.py env=<env>"):
        EpisodeStore.open(tmp_path / "nothing")
    path = record([20, 20], target=5)
    with pytest.raises(ValueError, match=r"holds 2 of 5 episodes: .*collect.py env=two_room.*allow_incomplete=True"):
        EpisodeStore.open(path)
    assert EpisodeStore.open(path, allow_incomplete=True).num_episodes == 2
    (path / INDEX_FILE).write_bytes(b"")
    with pytest.raises(ValueError, match="holds 0 of 5"):
        EpisodeStore.open(path, allow_incomplete=True)
    (path / INDEX_FILE).unlink()
    with pytest.raises(ValueError, match="episodes.jsonl is missing"):
        EpisodeStore.open(path)
    with pytest.raises(ValueError, match="verify must be"):
        EpisodeStore.open(path, verify="everything")


def test_writes_stay_in_the_process(record):
    path = record([20, 21])
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    store = EpisodeStore.open(path)
    for array in store.arrays.values():
        array[:] = 1
    other = EpisodeStore.open(path, verify="full")
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before
    assert other.arrays["state"][-1].tolist() == [2, 20]


def test_a_dataset_larger_than_memory_opens(tmp_path):
    header = Header(1, {"pixels": (3, 224, 224), "action": (1,), "state": (1,)}, {})
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    length = 3 * memory // header.row_bytes("pixels")
    write_header(tmp_path, header)
    (tmp_path / INDEX_FILE).write_bytes(IndexEntry(1, 0, length, 0, 0).to_line())
    for key in header.shapes:
        with open(tmp_path / f"{key}.memmap", "wb") as file:
            try:
                file.truncate(length * header.row_bytes(key))  # holes: takes no space
            except OSError:
                pytest.skip("this file system has no sparse files of that size")
    store = EpisodeStore.open(tmp_path, verify="none")
    assert store.arrays["pixels"][-1].sum() == 0
    store.arrays["pixels"][-1] = 1
    assert store.arrays["pixels"].nbytes > 2 * memory


def test_the_fingerprint_follows_the_content(record, make_episode):
    store = EpisodeStore.open(record([20, 21]))
    episodes = [make_episode(1, 20), make_episode(2, 21)]
    assert store.fingerprint == EpisodeStore.from_episodes(episodes).fingerprint
    episodes[1]["pixels"][3, 0, 0, 0] += 1
    assert store.fingerprint != EpisodeStore.from_episodes(episodes).fingerprint


def test_episodes_in_memory_meet_the_same_checks(make_episode):
    with pytest.raises(ValueError, match="at least one episode"):
        EpisodeStore.from_episodes([])
    with pytest.raises(ValueError, match="row shapes"):
        EpisodeStore.from_episodes([make_episode(1), make_episode(2, size=8)])
    with pytest.raises(KeyError, match="an episode holds"):
        EpisodeStore.from_episodes([{"pixels": make_episode(1)["pixels"]}])


def test_header_and_index_are_plain_json(record):
    path = record([20, 30])
    content = json.loads((path / "meta.json").read_text())
    assert content["shapes"] == {"pixels": [3, 4, 4], "action": [3], "state": [2]}
    assert content["dtypes"] == {"pixels": "|u1", "action": "<f4", "state": "<f8"}
    assert content["target_episodes"] == 2 and content["meta"]["env"] == "two_room"
    entries = [json.loads(line) for line in (path / "episodes.jsonl").read_text().splitlines()]
    assert [(entry["episode"], entry["start"], entry["length"]) for entry in entries] == [(1, 0, 20), (2, 20, 30)]
