"""Claims about sources that are incomplete, uneven or of unusual types.

1.  Frames and actions suffice: data without a state are converted, opened and cut into clips.
2.  Bad episodes, torn files and stray files are left out on request, with a notice of their number.
3.  Frames of another dtype, layout or number of channels are refused in one short line that says what they are.
4.  Arrays may be torch tensors or lists.
5.  Lists that differ in length are refused, also where they add up to the right number of values; so are frames that
    differ in size.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from foreign_files import encode, write_lance, write_lerobot, write_ogbench, write_swm_hdf5

from torchrl_ficreg.data import EpisodeStore, OfflineTrajectories
from torchrl_ficreg.data.convert import convert, from_arrays, measure_alignment, open_source
from torchrl_ficreg.data.convert._arrow import require_arrow, to_array
from torchrl_ficreg.data.convert.table import Column

LENGTHS = [30] * 6


def columns(rows, *names):
    return {name: rows[name] for name in names or ("pixels", "action", "state")}


@pytest.mark.parametrize("way", ["file", "arrays"])
def test_frames_and_actions_are_enough_to_train_on(tmp_path, make_rows, way):
    rows = make_rows(LENGTHS)
    rows.pop("state")
    if way == "file":
        source = open_source(write_swm_hdf5(tmp_path / "x.h5", rows))
    else:
        source = from_arrays(pixels=rows["pixels"], action=rows["action"], lengths=LENGTHS)
    with pytest.warns(UserWarning, match="no state was found"):
        path = convert(source, tmp_path / "target", progress=False)
    batch = OfflineTrajectories(path, batch_size=4, num_frames=2).sample()
    assert set(batch.keys()) >= {"pixels", "action"} and EpisodeStore.open(path).header.shapes["state"] == (0,)
    with pytest.raises(ValueError, match="holds no state"):
        OfflineTrajectories(path).store.require_state()


def test_the_state_of_a_named_environment_is_still_needed(tmp_path, make_rows):
    rows = make_rows(LENGTHS)
    rows.pop("state")
    with pytest.raises(KeyError, match="column for two_room's state"):
        open_source(write_swm_hdf5(tmp_path / "x.h5", rows), env="two_room")


@pytest.mark.parametrize("column", ["state", "action"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_episodes_are_left_out_on_request_and_counted(tmp_path, make_rows, expected, column, value):
    rows = make_rows(LENGTHS)
    want = expected(rows)
    rows[column][3 * 30 + 11, 0] = value
    rows[column][4 * 30 + 2, 1] = value
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    with pytest.raises(ValueError, match=f"episode 3: '{column}' holds a NaN .* row 11 of 30: .* skip_bad_episodes=True"):
        convert(path, tmp_path / "refused", progress=False)
    with pytest.warns(UserWarning, match="2 of 6 episodes are bad and left out; the first: .*episode 3"):
        store = EpisodeStore.open(convert(path, tmp_path / "target", skip_bad_episodes=True, progress=False))
    assert not from_arrays(**columns(make_rows(LENGTHS)), lengths=LENGTHS, skip_bad_episodes=True).notices
    kept = [want[index] for index in (0, 1, 2, 5)]
    assert store.num_episodes == 4
    np.testing.assert_array_equal(store.arrays["action"], np.concatenate([episode["action"] for episode in kept]))
    assert np.isfinite(store.header.meta["action_low"] + store.header.meta["action_high"]).all()


def test_nothing_but_bad_episodes_is_an_error(make_rows):
    rows = make_rows(LENGTHS)
    rows["state"][:] = np.nan
    with pytest.raises(ValueError, match="all 6 episodes are bad; the first: .*episode 0"):
        from_arrays(**columns(rows), lengths=LENGTHS, skip_bad_episodes=True)


def test_what_is_left_out_is_known_before_the_first_is_written(tmp_path, make_rows):
    """A conversion that was killed and is continued counts the same episodes."""
    rows = make_rows(LENGTHS)
    rows["state"][35] = np.nan
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    for limit in (2, None):
        with pytest.warns(UserWarning, match="1 of 6"):
            convert(path, tmp_path / "target", limit=limit, skip_bad_episodes=True, progress=False)
    assert EpisodeStore.open(tmp_path / "target").num_episodes == 5


@pytest.mark.parametrize("name", ["data/chunk-000/._file-000.parquet", "data/._x/y.parquet", "data/.hidden.parquet"])
def test_hidden_files_are_no_part_of_a_folder(tmp_path, make_rows, name):
    path = write_lerobot(tmp_path / "robot", make_rows(LENGTHS))
    (path / name).parent.mkdir(exist_ok=True)
    (path / name).write_bytes(b"\x00\x05\x16\x07" + bytes(4092))
    assert len(open_source(path)) == 6


@pytest.mark.parametrize("name", ["._x", "data/._x", "_versions/._1.manifest", ".DS_Store"])
def test_hidden_files_are_no_part_of_a_table(tmp_path, make_rows, name):
    path = write_lance(tmp_path / "table.lance", make_rows(LENGTHS))
    (path / name).write_bytes(b"\x00\x05\x16\x07" + bytes(4092))
    with open_source(path) as source:
        assert len(source) == 6 and source.episode(5)["action"].shape == (30, 2)


def test_a_torn_file_is_named_and_left_out_on_request(tmp_path, make_rows):
    path = write_lerobot(tmp_path / "robot", make_rows(LENGTHS))
    last = sorted(path.rglob("*.parquet"))[-1]
    last.write_bytes(last.read_bytes()[:-200])
    with pytest.raises(ValueError, match=f"{last.name} cannot be read .*allow_incomplete=True"):
        open_source(path)
    with open_source(path, allow_incomplete=True) as source:
        left = len(source)
        assert 0 < left < 6 and "1 of 2 files cannot be read and are left out" in source.notices
        source.episode(left - 1)


def test_some_episodes_of_a_folder_are_taken_on_request(tmp_path, make_rows):
    path = write_lerobot(tmp_path / "robot", make_rows(LENGTHS))
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps({**info, "total_frames": 900, "total_episodes": 30}))
    with pytest.raises(ValueError, match="promises 900 rows, found 180: .*allow_incomplete=True"):
        open_source(path)
    with open_source(path, allow_incomplete=True) as source:
        assert len(source) == 6 and "24 of 30 episodes are missing or incomplete" in source.notices


def test_an_episode_without_its_end_is_no_whole_one(tmp_path, make_rows):
    rows = make_rows(LENGTHS)
    cut = {**{name: data[:-10] for name, data in rows.items()}, "ep_len": np.array([*LENGTHS[:-1], 20])}
    path = write_lerobot(tmp_path / "robot", cut)
    (path / "meta/episodes.jsonl").write_text(
        "".join(json.dumps({"episode_index": number, "length": 30}) + "\n" for number in range(6))
    )
    with open_source(path, allow_incomplete=True) as source:
        assert len(source) == 5 and "1 incomplete episodes are left out" in source.notices


def frames_of(kind: str, count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    if kind == "encoded":
        files = [np.frombuffer(encode(rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)), np.uint8) for _ in range(count)]
        return np.stack([np.pad(file, (0, 2000 - len(file))) for file in files])
    shape, dtype = {
        "grey": ((16, 16), np.uint8),
        "grey with an axis": ((16, 16, 1), np.uint8),
        "RGBA": ((16, 16, 4), np.uint8),
        "stacked": ((12, 16, 16), np.uint8),
        "float32": ((16, 16, 3), np.float32),
        "float64": ((3, 16, 16), np.float64),
        "int64": ((16, 16, 3), np.int64),
        "uint16": ((16, 16, 3), np.uint16),
        "bool": ((16, 16, 3), bool),
    }[kind]
    return rng.integers(0, 2 if dtype == bool else 256, (count, *shape)).astype(dtype)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("grey", r"must be \[H, W, 3\]"),
        ("grey with an axis", r"must be \[H, W, 3\]"),
        ("RGBA", r"must be \[H, W, 3\]"),
        ("stacked", r"must be \[H, W, 3\]"),
        ("float32", "'pixels' is no uint8"),
        ("float64", "'pixels' is no uint8"),
        ("int64", "'pixels' is no uint8"),
        ("uint16", "'pixels' is no uint8"),
        ("bool", "'pixels' is no uint8"),
        ("encoded", r"encoded pictures\?"),
    ],
)
def test_frames_of_another_kind_are_named_as_what_they_are(tmp_path, make_rows, kind, words):
    rows = make_rows(LENGTHS)
    rows["pixels"] = frames_of(kind, len(rows["pixels"]))
    with pytest.raises((ValueError, KeyError), match=words) as error:
        open_source(write_swm_hdf5(tmp_path / "x.h5", rows))
    assert len(str(error.value)) < 350 and "x.h5" in str(error.value)


@pytest.mark.parametrize("layout", ["data/demo_{}", "episode_{}", "run/{}/data"])
def test_a_group_for_every_episode_is_named_in_one_short_line(tmp_path, layout):
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        for number in range(200):
            for key in ("actions", "dones", "obs/object", "obs/robot0_eef_pos", "states"):
                file[f"{layout.format(number)}/{key}"] = np.zeros((3, 2))
    with pytest.raises(ValueError, match="every episode in a group of its own") as error:
        open_source(tmp_path / "demo.h5")
    assert "from_arrays" in str(error.value) and len(str(error.value)) < 350


def test_a_folder_with_a_file_per_column_is_named_as_such(tmp_path):
    for name in ("ep_len", "ep_offset", "action", "proprio"):
        np.savez(tmp_path / f"{name}.npz", data=np.zeros(3))
    with pytest.raises(ValueError, match="stable-worldmodel with a file per column.*HDF5 or Lance"):
        open_source(tmp_path)


@pytest.mark.parametrize("kind", [torch.tensor, np.ndarray.tolist, list, lambda data: [torch.tensor(row) for row in data]])
def test_arrays_may_be_tensors_or_lists(make_rows, expected, kind):
    rows = make_rows([20, 20])
    want = expected(rows)
    source = from_arrays(**{name: kind(data) for name, data in columns(rows).items()}, lengths=kind(np.array([20, 20])))
    for index, episode in enumerate(want):
        for key, value in source.episode(index).items():
            np.testing.assert_array_equal(value, episode[key])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.int64, torch.bool])
def test_actions_of_any_dtype_of_torch_are_taken(make_rows, dtype):
    rows = make_rows([20, 20])
    action = torch.nan_to_num(torch.tensor(rows["action"])).to(dtype).requires_grad_(dtype.is_floating_point)
    source = from_arrays(**{**columns(rows), "action": action}, lengths=[20, 20])
    np.testing.assert_array_equal(source.episode(0)["action"][:-1], action[:19].float().detach())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pixels", torch.zeros(40, 16, 16, 3)),
        ("pixels", torch.zeros(40, 16, 16, 3, dtype=torch.int64)),
        ("pixels", [[[[300]]]] * 40),
        ("action", ["left"] * 40),
        ("action", [[1.0], [1.0, 2.0]] * 20),
        ("action", 7),
        ("action", np.zeros((40, 2), complex)),
        ("state", {"a": 1}),
        ("lengths", [20.5, 19.5]),
        ("lengths", [-1, 41]),
        ("lengths", [np.nan, 40]),
        ("lengths", [[20], [20], [0]]),
    ],
)
def test_what_is_no_array_of_the_right_kind_is_refused_by_its_name(make_rows, name, value):
    given = {**columns(make_rows([20, 20])), "lengths": [20, 20], name: value}
    with pytest.raises((TypeError, ValueError), match=name) as error:
        from_arrays(**given)
    assert "\n" not in str(error.value)


def test_lists_of_other_lengths_are_refused():
    arrow = require_arrow("pyarrow")
    kind = arrow.list_(arrow.float64())
    column = Column((2,), "number", 2)
    even = arrow.chunked_array([[[1.0, 2.0], [3.0, 4.0]]], kind)
    np.testing.assert_array_equal(to_array(even, column), [[1, 2], [3, 4]])
    with pytest.raises(ValueError, match=r"lists of 2 values were expected, got lengths \[1, 3\]"):
        to_array(arrow.chunked_array([[[1.0], [2.0, 3.0, 4.0]]], kind), column)


def test_frames_of_another_size_are_refused(make_rows, monkeypatch):
    rows = make_rows(lengths=[20, 20])
    columns = {key: rows[key] for key in ("pixels", "action", "state")}
    source = from_arrays(**columns, lengths=[20, 20])
    read = source.table.read

    def halved(name, start, stop):
        return read(name, start, stop)[:, ::2, ::2] if name == "pixels" else read(name, start, stop)

    monkeypatch.setattr(source.table, "read", halved)
    with pytest.raises(ValueError, match="frames must have one size"):
        source.episode(1)


def test_overflowing_states_are_not_called_aligned():
    action = np.random.default_rng(0).normal(size=(200, 2))
    state = np.concatenate([np.zeros((1, 2)), action.cumsum(0)[:-1]])
    with np.errstate(over="ignore", invalid="ignore"):
        assert measure_alignment([(np.roll(action, 1, 0), 1e200 * state)]).lag is None


def test_an_archive_with_a_damaged_small_array_is_refused_by_name(tmp_path, make_rows):
    path = write_ogbench(tmp_path / "play.npz", make_rows(dims=4))
    content = bytearray(path.read_bytes())
    place = content.find(b"terminals.npy") + 40
    content[place] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path.name} cannot be read .*damaged"):
        open_source(path)
