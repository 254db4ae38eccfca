"""Start-goal pairs: legal, held out, reproducible, and frozen to the last bit."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest
from scenes import make_dataset, make_pairs, same_room_pairs

from torchrl_ficreg.data import split_episodes
from torchrl_ficreg.evaluation import StartGoalPairs

DRAW = {"env": "two_room", "num_pairs": 20, "goal_offset": 5, "seed": 0}


def test_goals_lie_exactly_the_offset_later_in_the_same_held_out_episode():
    """States name their episode and step, so that every pair can be checked against what was recorded."""
    pairs = StartGoalPairs.draw(make_dataset(), **DRAW)
    held_out = set(split_episodes(40, "evaluation").tolist())
    assert set(pairs.episode.tolist()) <= held_out
    assert np.array_equal(pairs.start_state[:, 0], pairs.episode + 1 / 3)
    assert np.array_equal(pairs.start_state[:, 1], pairs.step + 1 / 7)
    assert np.array_equal(pairs.goal_state[:, 0], pairs.episode + 1 / 3)
    assert np.array_equal(pairs.goal_state[:, 1], pairs.step + 5 + 1 / 7)
    assert pairs.start_state.dtype == np.float64


def test_all_legal_starts_are_drawn_once_when_all_are_asked_for():
    """An episode of L rows has L - offset starts, the last of which has the last row as its goal."""
    data = make_dataset()
    lengths = zip(data.episodes["episode"].tolist(), data.episodes["length"].tolist())
    legal = [(episode, step) for episode, length in lengths for step in range(length - 5)]
    pairs = StartGoalPairs.draw(data, "two_room", len(legal), 5, seed=3)
    assert sorted(zip(pairs.episode.tolist(), pairs.step.tolist())) == sorted(legal)
    with pytest.raises(ValueError, match=f"cannot draw {len(legal) + 1} pairs .* have {len(legal)} such starts"):
        StartGoalPairs.draw(data, "two_room", len(legal) + 1, 5, seed=3)


def test_short_draws_do_not_repeat_and_reach_every_episode():
    """Over 200 seeds every legal start comes up about equally often."""
    data, count = make_dataset(), Counter()
    for seed in range(200):
        pairs = StartGoalPairs.draw(data, "two_room", 10, 5, seed)
        drawn = set(zip(pairs.episode.tolist(), pairs.step.tolist()))
        assert len(drawn) == 10
        count.update(drawn)
    total = int((data.episodes["length"] - 5).sum())
    assert len(count) == total and max(count.values()) < 2 * 2000 / total


@pytest.mark.parametrize(("number", "offset"), [(0, 5), (4, 0), (4, 100), (4, -3)])
def test_impossible_draws_are_refused(number, offset):
    with pytest.raises(ValueError, match="cannot draw .* Collect more episodes, or ask for fewer pairs"):
        StartGoalPairs.draw(make_dataset(), "two_room", number, offset, 0)


def test_the_seed_and_nothing_else_decides():
    first, again, other = (StartGoalPairs.draw(make_dataset(), **{**DRAW, "seed": seed}) for seed in (0, 0, 1))
    np.random.seed(7)  # noqa: NPY002  the global state takes no part
    assert first.hash == again.hash == StartGoalPairs.draw(make_dataset(), **DRAW).hash
    assert other.hash != first.hash
    assert not np.array_equal(other.start_state, first.start_state)


def test_the_hash_changes_with_every_single_field_and_with_the_last_bit_of_a_state():
    pairs = same_room_pairs()
    hashes = {pairs.hash}
    for field in fields(pairs):
        value = getattr(pairs, field.name)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            changed = value.copy()
            changed[-1, -1] = np.nextafter(changed[-1, -1], np.inf)
        elif isinstance(value, np.ndarray):
            changed = value.copy()
            changed[-1] += 1
        else:
            changed = value + (1 if isinstance(value, int) else "x")
        hashes.add(replace(pairs, **{field.name: changed}).hash)
    assert len(hashes) == 1 + len(fields(pairs))


def test_a_manifest_keeps_every_bit(tmp_path):
    """Thirds, the smallest double, a large one and a negative zero come back as they were."""
    pairs = same_room_pairs(2)
    odd = replace(pairs, start_state=np.array([[1 / 3, 5e-324], [-0.0, 1.7976931348623157e308]]))
    odd.save(tmp_path / "deep" / "pairs.json")
    back = StartGoalPairs.load(tmp_path / "deep" / "pairs.json")
    assert back.start_state.tobytes() == odd.start_state.tobytes()
    assert back.goal_state.tobytes() == odd.goal_state.tobytes()
    assert back.hash == odd.hash and len(back) == 2
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["pairs.json"]


@pytest.mark.parametrize("field", ["step", "hash"])
def test_a_manifest_changed_by_hand_is_refused(tmp_path, field):
    path = tmp_path / "pairs.json"
    same_room_pairs().save(path)
    content = json.loads(path.read_text())
    content[field] = "0" * 64 if field == "hash" else [1, *content[field][1:]]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="was changed after it was drawn"):
        StartGoalPairs.load(path)


TEXTS = ["", "[]", "3", "null", "{}", '{"hash": "x"}', "\udcff", '{"hash":1,"extra":2}', "[" * 10**5]


@pytest.mark.parametrize(
    "make",
    [
        *(lambda path, text=text: path.write_bytes(text.encode("utf-8", "surrogateescape")) for text in TEXTS),
        os.mkfifo,
        lambda path: path.symlink_to("/dev/zero"),
    ],
)
def test_what_is_no_manifest_is_refused_by_its_path_at_once(tmp_path, make):
    make(tmp_path / "pairs.json")
    with pytest.raises(ValueError, match="pairs.json is not a manifest") as error:
        StartGoalPairs.load(tmp_path / "pairs.json")
    assert len(str(error.value)) < 500


def test_runs_that_write_one_manifest_at_once_do_not_disturb_each_other(tmp_path):
    """As the runs of a sweep do, whose draws are the same."""
    pairs, path = make_pairs([[60, 60]] * 50, [[60, 140]] * 50), tmp_path / "pairs.json"
    with ThreadPoolExecutor(8) as pool:
        for done in [pool.submit(pairs.save, path) for _ in range(200)]:
            done.result()
    assert StartGoalPairs.load(path).hash == pairs.hash
    assert [file.name for file in tmp_path.iterdir()] == ["pairs.json"]


def test_frozen_pairs_are_drawn_once_and_read_ever_after_and_those_of_another_draw_or_dataset_refused(tmp_path):
    path = tmp_path / "pairs.json"
    first, written = StartGoalPairs.frozen(path, make_dataset(), **DRAW), path.read_bytes()
    assert StartGoalPairs.frozen(path, make_dataset(), **DRAW).hash == first.hash and path.read_bytes() == written
    for change in ({"num_pairs": 19}, {"goal_offset": 4}, {"seed": 1}, {"env": "push_t"}, {}):
        with pytest.raises(ValueError, match="another draw or dataset .* move it away"):
            StartGoalPairs.frozen(path, make_dataset(seed=0 if change else 1), **{**DRAW, **change})


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"goal_offset": "x"}, TypeError),
        ({"goal_offset": True}, TypeError),
        ({"goal_offset": 0}, ValueError),
        ({"seed": -1}, ValueError),
        ({"env": None}, TypeError),
        ({"episode": np.zeros(0, int), "step": np.zeros(0, int), "start_state": np.zeros((0, 2))}, ValueError),
        ({"episode": np.array([0.5, 1.0])}, TypeError),
        ({"episode": np.array([-1, 0])}, ValueError),
        ({"step": np.array([1])}, ValueError),
        ({"start_state": np.zeros((3, 2))}, ValueError),
        ({"goal_state": np.zeros((2, 3))}, ValueError),
        ({"goal_state": np.array([[0.0, np.nan], [0.0, 0.0]])}, ValueError),
        ({"start_state": np.array([["a", "b"], ["c", "d"]])}, TypeError),
        ({"start_state": np.zeros((2, 0)), "goal_state": np.zeros((2, 0))}, ValueError),
    ],
)
def test_fields_that_do_not_fit_together_are_refused_also_with_a_hash_that_fits(tmp_path, change, error):
    """A manifest is data from elsewhere: its hash says that nothing changed, not that it makes sense."""
    pairs = same_room_pairs(2)
    with pytest.raises(error):
        replace(pairs, **change)
    content = {**pairs._content(), **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in change.items()}}
    text = json.dumps(content, sort_keys=True)
    path = tmp_path / "pairs.json"
    path.write_text(json.dumps({**content, "hash": hashlib.sha256(text.encode()).hexdigest()}))
    with pytest.raises(ValueError, match="is not a manifest of start-goal pairs"):
        StartGoalPairs.load(path)


def test_a_manifest_is_not_written_through_a_link_and_a_failure_leaves_nothing(tmp_path):
    elsewhere, path = tmp_path / "elsewhere", tmp_path / "pairs.json"
    elsewhere.write_text("mine")
    path.symlink_to(elsewhere)
    same_room_pairs().save(path)
    assert elsewhere.read_text() == "mine" and not path.is_symlink()
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError):
        same_room_pairs().save(tmp_path / "folder")  # cannot be replaced by a file
    assert sorted(file.name for file in tmp_path.iterdir()) == ["elsewhere", "folder", "pairs.json"]
