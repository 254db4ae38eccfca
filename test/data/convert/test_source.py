"""Sources that are incomplete, uneven or of unusual types: left out on request, or refused in one short line."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from foreign_files import encode, write_lance, write_lerobot, write_swm_hdf5

from torchrl_ficreg.data import EpisodeStore, OfflineTrajectories
from torchrl_ficreg.data.convert import convert, from_arrays, open_source
from torchrl_ficreg.data.convert._arrow import require_arrow, to_array
from torchrl_ficreg.data.convert.table import Column

LENGTHS = [30] * 6


def columns(rows, *names):
    return {name: rows[name] for name in names or ("pixels", "action", "state")}


@pytest.mark.parametrize("way", ["file", "arrays"])
def test_frames_and_actions_are_enough_to_train_on(tmp_path, make_rows, way):
    """Unless an environment is named."""
    rows = make_rows(LENGTHS)
    rows.pop("state")
    if way == "file":
        source = open_source(write_swm_hdf5(tmp_path / "x.h5", rows))
        with pytest.raises(KeyError, match="column for two_room's state"):
            open_source(tmp_path / "x.h5", env="two_room")
    else:
        source = from_arrays(pixels=rows["pixels"], action=rows["action"], lengths=LENGTHS)
    with pytest.warns(UserWarning, match="no state was found"):
        path = convert(source, tmp_path / "target", progress=False)
    dataset = OfflineTrajectories(path, batch_size=4, num_frames=2)
    assert set(dataset.sample().keys()) >= {"pixels", "action"} and dataset.store.header.shapes["state"] == (0,)
    with pytest.raises(ValueError, match="holds no state"):
        dataset.store.require_state()


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


def test_what_is_left_out_is_known_before_the_first_is_written(tmp_path, make_rows):
    """A conversion that was killed and is continued counts the same episodes; nothing but bad ones is an error."""
    rows = make_rows(LENGTHS)
    rows["state"][35] = np.nan
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    for limit in (2, None):
        with pytest.warns(UserWarning, match="1 of 6"):
            convert(path, tmp_path / "target", limit=limit, skip_bad_episodes=True, progress=False)
    assert EpisodeStore.open(tmp_path / "target").num_episodes == 5
    rows["state"][:] = np.nan
    with pytest.raises(ValueError, match="all 6 episodes are bad; the first: .*episode 0"):
        from_arrays(**columns(rows), lengths=LENGTHS, skip_bad_episodes=True)


@pytest.mark.parametrize(
    ("writer", "name"),
    [(write_lerobot, f"data/{name}") for name in ("chunk-000/._file-000.parquet", "._x/y.parquet", ".hidden.parquet")]
    + [(write_lance, name) for name in ("._x", "data/._x", "_versions/._1.manifest", ".DS_Store")],
)
def test_hidden_files_are_no_part_of_a_folder(tmp_path, make_rows, writer, name):
    path = writer(tmp_path / "table.lance", make_rows(LENGTHS))
    (path / name).parent.mkdir(exist_ok=True)
    (path / name).write_bytes(b"\x00\x05\x16\x07" + bytes(4092))
    with open_source(path) as source:
        assert len(source) == 6 and source.episode(5)["action"].shape == (30, 2)


def test_what_is_incomplete_in_a_folder_is_left_out_on_request(tmp_path, make_rows):
    """A torn file, episodes that were promised, and an episode without its end."""

    def check(path, refused, episodes, notice):
        if refused:
            with pytest.raises(ValueError, match=f"{refused}.*allow_incomplete=True"):
                open_source(path)
        with open_source(path, allow_incomplete=True) as source:
            assert len(source) == episodes and notice in source.notices
            source.episode(episodes - 1)

    torn, promising, cut = (tmp_path / name for name in ("torn", "promising", "cut"))
    last = sorted(write_lerobot(torn, make_rows(LENGTHS)).rglob("*.parquet"))[-1]
    last.write_bytes(last.read_bytes()[:-200])
    check(torn, f"{last.name} cannot be read ", 3, "1 of 2 files cannot be read and are left out")
    file = write_lerobot(promising, make_rows(LENGTHS)) / "meta/info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "total_frames": 900, "total_episodes": 30}))
    check(promising, "promises 900 rows, found 180: ", 6, "24 of 30 episodes are missing or incomplete")
    rows = {name: data[:-10] for name, data in make_rows(LENGTHS).items()}
    write_lerobot(cut, {**rows, "ep_len": np.array([*LENGTHS[:-1], 20])})
    index = [json.dumps({"episode_index": number, "length": 30}) + "\n" for number in range(6)]
    (cut / "meta/episodes.jsonl").write_text("".join(index))
    check(cut, None, 5, "1 incomplete episodes are left out")


@pytest.mark.parametrize(
    ("shape", "dtype", "words"),
    [(shape, np.uint8, r"must be \[H, W, 3\]") for shape in ((16, 16), (16, 16, 1), (16, 16, 4), (12, 16, 16))]
    + [((16, 16, 3), dtype, "'pixels' is no uint8") for dtype in (np.float32, np.float64, np.int64, np.uint16, bool)]
    + [("encoded", np.uint8, r"encoded pictures\?")],
)
def test_frames_of_another_kind_are_named_as_what_they_are(tmp_path, make_rows, shape, dtype, words):
    rows, rng = make_rows(LENGTHS), np.random.default_rng(0)
    if shape == "encoded":
        files = [np.frombuffer(encode(frame), np.uint8) for frame in rng.integers(0, 256, (180, 16, 16, 3), dtype=np.uint8)]
        rows["pixels"] = np.stack([np.pad(file, (0, 2000 - len(file))) for file in files])
    else:
        rows["pixels"] = rng.integers(0, 2 if dtype == bool else 256, (180, *shape)).astype(dtype)
    with pytest.raises((ValueError, KeyError), match=words) as error:
        open_source(write_swm_hdf5(tmp_path / "x.h5", rows))
    assert len(str(error.value)) < 350 and "x.h5" in str(error.value)


@pytest.mark.parametrize("layout", ["data/demo_{}", "episode_{}", "run/{}/data"])
def test_layouts_that_are_not_read_are_named_in_one_short_line(tmp_path, layout):
    """A group for every episode; a folder with a file per column."""
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("hdf5plugin")
    for name in ("ep_len", "ep_offset", "action", "proprio"):
        np.savez(tmp_path / f"{name}.npz", data=np.zeros(3))
    with pytest.raises(ValueError, match="stable-worldmodel with a file per column.*HDF5 or Lance"):
        open_source(tmp_path)
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        for number in range(200):
            for key in ("actions", "dones", "obs/object", "obs/robot0_eef_pos", "states"):
                file[f"{layout.format(number)}/{key}"] = np.zeros((3, 2))
    with pytest.raises(ValueError, match="every episode in a group of its own") as error:
        open_source(tmp_path / "demo.h5")
    assert "from_arrays" in str(error.value) and len(str(error.value)) < 350


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
        ("lengths", None),
        ("lengths", [20, 19]),
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
    source = from_arrays(**columns(make_rows(lengths=[20, 20])), lengths=[20, 20])
    read = source.table.read
    halved = {"pixels": (slice(None), slice(None, None, 2), slice(None, None, 2))}
    monkeypatch.setattr(source.table, "read", lambda name, start, stop: read(name, start, stop)[halved.get(name, ...)])
    with pytest.raises(ValueError, match="frames must have one size"):
        source.episode(1)
