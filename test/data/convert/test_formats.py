"""Every layout becomes the same episodes; what is missing, damaged, cut off or out of order is refused with what to do."""

from __future__ import annotations

import json

import numpy as np
import pytest
from foreign_files import write_lance, write_lerobot, write_lewm, write_ogbench, write_swm_hdf5

from torchrl_ficreg.data.convert import detect_format, from_arrays, open_source

LENGTHS = [31, 40, 25, 33, 28, 36]


def check_equal(source, episodes, *, frame_tolerance=0, tolerance=0.0):
    assert len(source) == len(episodes)
    for index, want in enumerate(episodes):
        got = source.episode(index)
        assert {key: value.dtype for key, value in got.items()} == {key: value.dtype for key, value in want.items()}
        assert abs(got["pixels"].astype(int) - want["pixels"]).max() <= frame_tolerance
        np.testing.assert_array_equal(got["action"], want["action"])
        np.testing.assert_allclose(got["state"], want["state"], rtol=tolerance)


def test_every_layout_becomes_the_same_episodes(tmp_path, layout, write, make_rows, expected):
    rows = make_rows(dims=4)
    with open_source(write[layout](tmp_path, rows)) as source:
        single = layout in ("lance", "lerobot", "ogbench")  # states in single precision
        check_equal(source, expected(rows), frame_tolerance=2 * (layout == "lance"), tolerance=1e-6 * single)
        assert source.lengths.tolist() == LENGTHS
        np.testing.assert_array_equal(source.episode(2)["pixels"], source.episode(2)["pixels"])  # also backwards


@pytest.mark.parametrize(("ids", "dtype"), [("ep_idx", np.int32), ("episode_idx", np.int64), ("ep_idx", None)])
def test_ids_have_either_name_and_are_enough(tmp_path, make_rows, expected, ids, dtype):
    """A real last action leads nowhere either: the official PushT file has one where the others have NaN."""
    rows = make_rows(dims=7)
    want = expected(rows)
    if dtype is None:
        del rows["ep_len"]
    else:
        rows["action"] = np.nan_to_num(rows["action"], nan=0.3)
    rows["ep_idx"] = rows["ep_idx"].astype(dtype or int)
    with open_source(write_lewm(tmp_path / "x.h5", rows, ids=ids), env="push_t") as source:
        check_equal(source, want)


@pytest.mark.parametrize(
    ("env", "dims", "names"),
    [
        ("two_room", 2, ["pos_agent"]),
        ("two_room", 2, ["proprio"]),
        ("push_t", 7, ["state"]),
        ("reacher", 4, ["qpos", "qvel"]),
        ("cube", 41, ["qpos", "qvel"]),
    ],
)
def test_each_environment_knows_its_state(tmp_path, make_rows, expected, env, dims, names):
    rows = make_rows(dims=dims)
    if env == "cube":
        rows["action"] = np.concatenate([rows["action"], rows["action"], rows["action"][:, :1]], 1)
    want = expected(rows)
    state = rows.pop("state")
    rows.update(zip(names, np.split(state, [dims * 21 // 41] if env == "cube" else [2], 1)))
    if len(names) == 1:
        rows[names[0]] = state
    with open_source(write_lewm(tmp_path / "x.h5", rows), env=env) as source:
        check_equal(source, want)
        assert source.columns["state"] == names
    with pytest.raises(ValueError, match="numbers of"):
        open_source(tmp_path / "x.h5", env="push_t" if env != "push_t" else "two_room", state=names)


@pytest.mark.parametrize("spelling", ["proprio/joint_pos", "proprio_joint_pos"])
@pytest.mark.parametrize("wanted", ["proprio/joint_pos", "proprio_joint_pos", "proprio.joint_pos"])
@pytest.mark.parametrize("writer", [write_swm_hdf5, write_lance])
def test_slashes_dots_and_underscores_are_one_letter(tmp_path, make_rows, expected, spelling, wanted, writer):
    rows = make_rows([20, 21])
    want = expected(rows)
    rows[spelling] = rows.pop("state")
    with open_source(writer(tmp_path / "x", rows), state=[wanted]) as source:
        check_equal(source, want, frame_tolerance=2, tolerance=1e-6)
        assert source.columns["state"] == [spelling]


def test_arrays_of_ones_own_are_sliced_not_copied(make_rows, expected):
    rows = make_rows()
    want = expected(rows)
    arrays = {key: rows[key] for key in ("pixels", "action", "state")}
    check_equal(from_arrays(**arrays, episode_ends=np.cumsum(LENGTHS)), want)
    channels_first = {**arrays, "pixels": rows["pixels"].transpose(0, 3, 1, 2)}
    check_equal(from_arrays(**channels_first, lengths=LENGTHS), want)
    with pytest.raises(ValueError, match="episodes of 192 rows in all"):
        from_arrays(**arrays, lengths=[*LENGTHS[:-1], 35])
    with pytest.raises(ValueError, match="must be uint8 from 0 to 255 of shape .*, got float32"):
        from_arrays(**{**arrays, "pixels": rows["pixels"].astype(np.float32)}, lengths=LENGTHS)


def test_the_format_is_found_from_the_content(tmp_path, write, make_rows):
    rows = make_rows([20, 20])
    names = {"lewm": "hdf5", "swm": "hdf5", "lance": "lance", "ogbench": "ogbench", "lerobot": "lerobot"}
    for layout, name in names.items():
        path = write[layout](tmp_path, rows)
        assert detect_format(path.rename(path.with_name(f"{layout}_without_a_suffix"))) == name


def test_what_is_no_data_set_is_named_as_what_it_is(tmp_path):
    for name, content, message in (
        ("x.tar.zst", b"\x28\xb5\x2f\xfd....", "unpack it first .*tar --zstd -xf x.tar.zst"),
        ("y.h5", b"version https://git-lfs...", "git lfs pull"),
        ("z.txt", b"hello, world", "known are hdf5 .* lance .* ogbench .* lerobot"),
        (".", None, "folder of data sets: choose one of .y.h5. in it"),
        ("meta.json", b"{}", None),
        (".", None, "dataset of this package already"),
    ):
        if content:
            (tmp_path / name).write_bytes(content)
        if message:
            with pytest.raises(ValueError, match=message):
                detect_format(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="correct the path"):
        open_source(tmp_path / "nothing")
    with pytest.raises(ValueError, match="unknown format 'tfrecord'"):
        open_source(tmp_path / "z.txt", "tfrecord")


@pytest.mark.parametrize("lost", ["pixels", "action", "state"])
def test_a_missing_column_is_named_with_those_that_are_there(tmp_path, make_rows, lost):
    rows = make_rows([20, 20])
    data = rows.pop(lost)
    rows["other"] = np.zeros((40, 3))
    path = write_lewm(tmp_path / "x.h5", rows)
    with pytest.raises(KeyError, match=f"column for .*{lost}: tried"):
        open_source(path, env="two_room")
    if lost != "pixels":
        with pytest.raises(KeyError, match=f"name the column by {lost}="):
            open_source(path, env="two_room")
        rows["mine"] = data
        assert len(open_source(write_lewm(tmp_path / "y.h5", rows), **{lost: "mine"})) == 2


def test_frames_that_are_not_there_or_in_videos_are_refused_with_a_way_out(tmp_path, make_rows):
    with pytest.raises(KeyError, match="visual-"):
        open_source(write_ogbench(tmp_path / "x.npz", make_rows(dims=4), visual=False))
    with pytest.raises(ValueError, match="observation.images.top. in video files.*use_videos=False.*from_arrays"):
        open_source(write_lerobot(tmp_path / "robot", make_rows([20, 20]), video=True))


@pytest.mark.parametrize("keep", [0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused(tmp_path, layout, write, make_rows, keep):
    """Cut off as by an interrupted copy: at the door, or at the first episode that is not whole."""
    path = write[layout](tmp_path, make_rows())
    files = [file for file in sorted(path.rglob("*")) if file.suffix in (".lance", ".parquet")] or [path]
    content = files[-1].read_bytes()
    files[-1].write_bytes(content[: int(keep * len(content))])
    with pytest.raises(ValueError, match="damaged|incomplete"):
        with open_source(path) as source:
            for index in range(len(source)):
                source.episode(index)


@pytest.mark.parametrize(
    ("array", "place", "message"),
    [
        (b"observations.npy", 400, "rows .* of 'observations' cannot be read"),
        (b"terminals.npy", 40, "x.npz cannot be read .*damaged"),  # small ones are read at once
    ],
)
def test_damage_inside_is_named_by_its_rows(tmp_path, make_rows, array, place, message):
    path = write_ogbench(tmp_path / "x.npz", make_rows(size=32, dims=4))
    content = bytearray(path.read_bytes())
    start = content.find(array) + place
    content[start : start + 24] = bytes(24)
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match=message), open_source(path) as source:
        for index in range(len(source)):
            source.episode(index)


def test_an_interrupted_recording_is_refused_or_cut(tmp_path, make_rows, expected):
    rows = make_rows()
    want = expected(rows)
    cut = {name: data if name == "ep_len" else data[:-10] for name, data in rows.items()}
    path = write_swm_hdf5(tmp_path / "x.h5", cut)
    with pytest.raises(ValueError, match="end at row 193, its columns at row 183.*take the 5 whole episodes"):
        open_source(path)
    with open_source(path, allow_incomplete=True) as source:
        check_equal(source, want[:-1])


def test_episodes_in_pieces_and_missing_rows_are_refused(tmp_path, make_rows):
    rows = make_rows([20, 20, 20])
    rows["ep_idx"] = np.repeat([0, 1, 0], 20)
    rows.pop("ep_len")
    with pytest.raises(ValueError, match="episode 0 are not next to each other"):
        open_source(write_lewm(tmp_path / "x.h5", rows))
    rows = make_rows([20, 20])
    kept = np.delete(np.arange(40), 7)
    gap = {name: data if name == "ep_len" else data[kept] for name, data in rows.items()}
    with pytest.raises(ValueError, match="row 7 holds step 8, expected 7"):
        open_source(write_lance(tmp_path / "x.lance", gap))
    path = write_lerobot(tmp_path / "robot", rows)
    info = json.loads((path / "meta" / "info.json").read_text())
    (path / "meta" / "info.json").write_text(json.dumps({**info, "total_frames": 50}))
    with pytest.raises(ValueError, match="promises 50 rows, found 40"):
        open_source(path)


def test_episodes_of_one_row_are_left_out(make_rows):
    rows = make_rows([20, 1, 21])
    source = from_arrays(**{key: rows[key] for key in ("pixels", "action", "state")}, lengths=[20, 1, 21])
    assert source.lengths.tolist() == [20, 21] and source.skipped == 1
    assert source.episode(1)["pixels"][0, :, 0, 0].tolist() == [20, 0, 0]
