"""Claims about files that somebody made, or damaged, so that reading them does harm.

1.  Only JPEG, PNG and WebP are opened as pictures: no other decoder runs, and no program is started.
2.  Nothing outside of a file or folder is read: no external storage, virtual data set, link or other base folder.
3.  Sizes that are declared but not there are refused before memory is asked for.
4.  Whatever a library raises about a damaged file becomes one line that names the file.
"""

from __future__ import annotations

import io
import json
import os
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from foreign_files import encode, SIZE, write_lance, write_lerobot, write_ogbench, write_swm_hdf5

from torchrl_ficreg.data.convert import open_source
from torchrl_ficreg.data.convert.images import decode
from torchrl_ficreg.data.convert.table import reading

MIB = 2**20
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n%%EOF\n"


def read_all(path: Path, **options) -> int:
    """Opens a source and reads every episode."""
    with open_source(path, **options) as source:
        for index in range(len(source)):
            source.episode(index)
        return len(source)


def one_line(error: pytest.ExceptionInfo, name: str) -> str:
    """The message, which names the file in one line of a bounded length."""
    text = str(error.value.args[0])
    assert name in text and "\n" not in text and len(text) < 450, text
    return text


def other_picture(kind: str) -> bytes:
    """A picture of a format that is none of ours."""
    if kind == "EPS":
        return EPS
    image, buffer = pytest.importorskip("PIL.Image"), io.BytesIO()
    image.new("RGB", (SIZE, SIZE)).save(buffer, kind)
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ["EPS", "PPM", "GIF", "TIFF", "BMP", "ICO", "TGA"])
def test_only_known_pictures_are_decoded(kind):
    assert decode([encode(np.full((SIZE, SIZE, 3), 7, np.uint8), known) for known in ("PNG", "PNG")]).max() == 7
    with pytest.raises(ValueError, match="picture of row 5 cannot be decoded"):
        decode([other_picture(kind)], first_row=5)


@pytest.mark.parametrize("writer", [write_lance, write_lerobot])
@pytest.mark.parametrize("row", [0, 25])
def test_a_picture_in_a_table_starts_no_program(tmp_path, make_rows, monkeypatch, writer, row):
    """Pillow hands EPS to ``gs``: here a program of that name that leaves a mark."""
    tools, mark = tmp_path / "tools", tmp_path / "mark"
    tools.mkdir()
    (tools / "gs").write_text(f"#!/bin/sh\ntouch {mark}\n")
    (tools / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    rows = make_rows([20, 20])
    monkeypatch.setattr(
        "foreign_files.encode",
        lambda frame, kind="JPEG": EPS if (frame[0, 0] == rows["pixels"][row, 0, 0]).all() else encode(frame, kind),
    )
    with pytest.raises((ValueError, KeyError)) as error:
        read_all(writer(tmp_path / "table", rows), state="state" if writer is write_lance else None)
    one_line(error, "table")
    assert not mark.exists()


SECRET = b"-----BEGIN PRIVATE KEY-----" * 40_000


def external_storage(file, name, data, secret):
    file.create_dataset(name, shape=data.shape, dtype=data.dtype, external=[(str(secret), 0, data.nbytes)])


def virtual_file(file, name, data, secret):
    h5py = pytest.importorskip("h5py")
    with h5py.File(secret.with_name("other.h5"), "w") as other:
        other["x"] = data
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(secret.with_name("other.h5"), "x", data.shape)
    file.create_virtual_dataset(name, layout)


def virtual_chain(file, name, data, secret):
    """Virtual over a virtual one of this file, which is over another file."""
    h5py = pytest.importorskip("h5py")
    virtual_file(file, "between", data, secret)
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(".", "between", data.shape)
    file.create_virtual_dataset(name, layout)


def external_link(file, name, data, secret):
    h5py = pytest.importorskip("h5py")
    with h5py.File(secret.with_name("other.h5"), "w") as other:
        other["x"] = data
    file[name] = h5py.ExternalLink(str(secret.with_name("other.h5")), "x")


def link_to_a_link(file, name, data, secret):
    h5py = pytest.importorskip("h5py")
    external_link(file, "between", data, secret)
    file[name] = h5py.SoftLink("/between")


@pytest.mark.parametrize("column", ["pixels", "action", "ep_len", "ep_idx"])
@pytest.mark.parametrize("way", [external_storage, virtual_file, virtual_chain, external_link, link_to_a_link])
def test_a_file_reads_no_other_file(tmp_path, make_rows, way, column):
    """Frames made of somebody's private key would be handed on with the dataset."""
    h5py = pytest.importorskip("h5py")
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET)
    rows = make_rows([20, 20])
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    with h5py.File(path, "r+") as file:
        if column == "ep_idx":  # with nothing else that says where the episodes are
            del file["ep_len"], file["ep_offset"]
        elif column in file:
            del file[column]
        way(file, column, rows[column], secret)
    with pytest.raises((ValueError, KeyError)) as error:
        read_all(path)
    text = one_line(error, "x.h5")
    assert "not followed" in text or "no array of this file" in text or column == "ep_idx"


def test_what_is_not_followed_does_not_refuse_the_rest(tmp_path, make_rows):
    h5py = pytest.importorskip("h5py")
    rows = make_rows([20, 20])
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    (tmp_path / "secret").write_bytes(SECRET)
    with h5py.File(path, "r+") as file:
        for number, way in enumerate((external_storage, virtual_file, external_link, link_to_a_link)):
            way(file.create_group(f"part{number}"), "depth", rows["action"], tmp_path / "secret")
        file["loop"] = h5py.SoftLink("/loop")
        file["nowhere"] = h5py.SoftLink("/part9/depth")
        file["self"] = file["/"]
    assert read_all(path) == 2


def test_links_and_virtual_data_sets_within_a_file_are_columns(tmp_path, make_rows, expected):
    h5py = pytest.importorskip("h5py")
    rows = make_rows([20, 20])
    want = expected(rows)
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    with h5py.File(path, "r+") as file:
        file.move("pixels", "raw/cam0/rgb")
        file["camera"] = h5py.SoftLink("/raw/cam0")  # of a group
        file["pixels"] = h5py.SoftLink("camera/rgb")  # relative, through the other link
        file.move("action", "raw/action")
        layout = h5py.VirtualLayout(rows["action"].shape, rows["action"].dtype)
        layout[:] = h5py.VirtualSource(".", "raw/action", rows["action"].shape)
        file.create_virtual_dataset("action", layout)
    with open_source(path) as source:
        assert source.columns["pixels"] == ["pixels"]
        for index, episode in enumerate(want):
            for key, value in source.episode(index).items():
                np.testing.assert_array_equal(value, episode[key])


@pytest.mark.parametrize("writer", [write_lance, write_lerobot])
def test_links_out_of_a_folder_are_refused(tmp_path, make_rows, writer):
    path = writer(tmp_path / "table", make_rows([20, 20]))
    for file in sorted(path.rglob("*")):
        if file.suffix in (".lance", ".parquet", ".manifest", ".json"):
            moved = file.rename(tmp_path / f"outside{file.suffix}")
            file.symlink_to(moved)
            with pytest.raises(ValueError) as error:
                read_all(path)
            assert "leads out of" in one_line(error, file.name)
            file.unlink()
            moved.rename(file)
    assert read_all(path) == 2


def test_files_of_the_download_cache_may_be_links(tmp_path, make_rows):
    """Hugging Face keeps a snapshot as links to the blobs beside it."""
    path = write_lerobot(tmp_path / "snapshots" / "abc", make_rows([20, 20]))
    (tmp_path / "blobs").mkdir()
    for number, file in enumerate(sorted(path.rglob("*.parquet"))):
        file.symlink_to(file.rename(tmp_path / "blobs" / str(number)))
    assert read_all(path) == 2


def test_a_lance_table_reads_no_other_folder(tmp_path, make_rows):
    lance = pytest.importorskip("lance")
    rows = lance.dataset(write_lance(tmp_path / "plain.lance", make_rows([20, 20]))).to_table()
    bases = [lance.DatasetBasePath(str(tmp_path / "elsewhere"), name="b")]
    path = tmp_path / "table.lance"
    lance.write_dataset(rows, str(path), initial_bases=bases, target_bases=["b"], mode="create")
    with pytest.raises(ValueError) as error:
        open_source(path)
    assert "outside of its folder" in one_line(error, "table.lance")


def bomb(width: int, height: int) -> bytes:
    """A PNG of some hundred bytes that declares width x height pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


@pytest.mark.filterwarnings("ignore:Image size")  # Pillow's own, of the sizes between its two limits
@pytest.mark.parametrize("size", [(12_000, 12_000), (100_000, 100_000), (2**31 - 1, 2**31 - 1), (2, 2**30)])
@pytest.mark.parametrize("row", [0, 1])
def test_a_picture_that_declares_too_much_is_refused_before_it_is_decoded(size, row):
    cells = [encode(np.zeros((SIZE, SIZE, 3), np.uint8), "PNG")] * 2
    cells[row] = bomb(*size)
    tracemalloc.start()
    with pytest.raises(ValueError, match="declares|cannot be decoded"):
        decode(cells)
    assert tracemalloc.get_traced_memory()[1] < 64 * MIB
    tracemalloc.stop()


def never_written(shape, dtype):
    def write(file, name):
        del file[name]
        file.create_dataset(name, shape=shape, dtype=dtype, chunks=(8, *(min(size, 8) for size in shape[1:])))

    return write


def rewritten(values):
    def write(file, name):
        del file[name]
        file[name] = values

    return write


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("ep_len", never_written((2**40,), "i8")),
        ("ep_offset", never_written((2**40,), "i8")),
        ("ep_len", rewritten(np.array([10**9, 10**9]))),
        ("ep_len", rewritten(np.array([2**62, 2**62]))),
        ("ep_len", rewritten(np.array([-3, 20]))),
        ("ep_len", rewritten(np.array([12.7, 20]))),
        ("ep_len", rewritten(np.array([np.nan, 20]))),
        ("ep_len", rewritten(np.array([b"12", b"20"]))),
        ("ep_offset", rewritten(np.array([0, 2**62]))),
        ("ep_offset", rewritten(np.array([0]))),
        ("pixels", never_written((40, 100_000, 100_000, 3), "u1")),
        ("action", never_written((40, 10**9), "f4")),
    ],
)
def test_hdf5_sizes_are_compared_before_memory_is_asked_for(tmp_path, make_rows, column, change):
    h5py = pytest.importorskip("h5py")
    path = write_swm_hdf5(tmp_path / "x.h5", make_rows([20, 20]))
    with h5py.File(path, "r+") as file:
        change(file, column)
    tracemalloc.start()
    with pytest.raises(ValueError) as error:
        read_all(path)
    assert tracemalloc.get_traced_memory()[1] < 64 * MIB
    tracemalloc.stop()
    one_line(error, "x.h5")


def test_one_episode_of_a_billion_rows_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, shape, dtype in (("pixels", (16, 16, 3), "u1"), ("action", (2,), "f4"), ("state", (2,), "f8")):
            file.create_dataset(name, shape=(10**9, *shape), dtype=dtype, chunks=(1024, *shape))
        file["ep_len"], file["ep_offset"] = np.array([10**9]), np.array([0])
    with pytest.raises(ValueError) as error:
        read_all(tmp_path / "x.h5")
    assert "more than are read at once" in one_line(error, "x.h5")


@pytest.mark.parametrize("declared", [(10**9,), (2**62,), (-1,), (4, 10**9), (2**40, 2**40)])
def test_npz_sizes_are_compared_with_the_file(tmp_path, make_rows, declared):
    path = write_ogbench(tmp_path / "x.npz", make_rows([20, 20], dims=4))
    header = np.lib.format.header_data_from_array_1_0(np.zeros(1, np.float32))
    for member in ("terminals", "actions", "observations"):
        buffer = io.BytesIO()
        np.lib.format.write_array_header_1_0(buffer, {**header, "shape": declared})
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / f"{member}.npz", "w") as new:
            for name in old.namelist():
                new.writestr(name, buffer.getvalue() + bytes(80) if name == f"{member}.npy" else old.read(name))
        with pytest.raises((ValueError, KeyError)) as error:
            read_all(tmp_path / f"{member}.npz")
        one_line(error, f"{member}.npz")


def test_terminals_are_zero_or_one(tmp_path, make_rows):
    path = write_ogbench(tmp_path / "x.npz", make_rows([20, 20], dims=4))
    with np.load(path) as archive:
        arrays = dict(archive)
    for value in (np.nan, 2, -1):
        terminals = arrays["terminals"].copy()
        terminals[5] = value
        np.savez(path, **{**arrays, "terminals": terminals})
        with pytest.raises(ValueError, match="x.npz: 'terminals' holds .* in row 5: 0 or 1 is expected"):
            open_source(path)


@pytest.mark.parametrize("features", [[], None, "image", {"a": None}, {"a": "video"}, {"a": []}, 7])
def test_features_of_any_type_are_no_reason_to_refuse(tmp_path, make_rows, features):
    path = write_lerobot(tmp_path / "robot", make_rows([20, 20]))
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps({**info, "features": features}))
    assert read_all(path) == 2


@pytest.mark.parametrize(
    "text",
    ["[]", "null", "7", '"x"', "{", "", "\x00", "[" * 100_000, '{"total_frames": "many"}', '{"total_frames": 1e999}']
    + ['{"total_frames": -1}', '{"total_frames": true}', '{"total_frames": [40]}', '{"total_frames": 1%s}' % ("0" * 5000)],
)
def test_a_damaged_description_is_refused_in_one_line(tmp_path, make_rows, text):
    path = write_lerobot(tmp_path / "robot", make_rows([20, 20]))
    (path / "meta/info.json").write_text(text)
    with pytest.raises(ValueError) as error:
        read_all(path)
    one_line(error, "robot")


@pytest.mark.parametrize("kind", [RuntimeError, AttributeError, MemoryError, OverflowError, RecursionError, "PanicException"])
def test_whatever_a_library_raises_names_the_file(kind):
    """Libraries written in Rust report damage by a class of their own, which is no Exception."""
    if isinstance(kind, str):
        kind = type(kind, (BaseException,), {"__module__": "pyo3_runtime"})
    with pytest.raises(ValueError) as error:
        with reading(Path("some/file.h5")):
            raise kind("a\nb" * 500)
    one_line(error, "some/file.h5")


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, ImportError, FileNotFoundError])
def test_what_is_not_about_the_file_stays_what_it_is(kind):
    with pytest.raises(kind, match="^x$"):
        with reading(Path("some/file.h5")):
            raise kind("x")


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32])
def test_a_picture_of_more_than_8_bits_is_refused_not_cut_off(tmp_path, make_rows, dtype):
    image, parquet, arrow = (pytest.importorskip(name) for name in ("PIL.Image", "pyarrow.parquet", "pyarrow"))
    picture = image.fromarray((np.arange(SIZE * SIZE).reshape(SIZE, SIZE) * 200).astype(dtype))
    if picture.mode == "F":
        picture = picture.convert("I")
    buffer = io.BytesIO()
    picture.convert("I;16").save(buffer, "PNG")
    path = write_lerobot(tmp_path / "robot", make_rows([20, 20]))
    for file in (path / "data").rglob("*.parquet"):
        table = parquet.read_table(file)
        place, cells = table.column_names.index("observation.images.top"), [{"bytes": buffer.getvalue(), "path": ""}] * len(table)
        parquet.write_table(table.set_column(place, "observation.images.top", arrow.array(cells)), file)
    with pytest.raises(KeyError) as error:
        open_source(path)
    assert "8 bits" in one_line(error, "robot")


@pytest.mark.parametrize("writer", [write_lerobot, write_lance])
def test_a_first_row_of_many_numbers_is_refused_before_it_becomes_objects(tmp_path, make_rows, writer):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = writer(tmp_path / "table.lance", make_rows([20, 20]))
    junk = arrow.array([np.zeros(20 * MIB, np.float32)] + [[]] * 19, arrow.list_(arrow.float32()))
    if writer is write_lerobot:
        file = min((path / "data").rglob("*.parquet"))
        parquet.write_table(parquet.read_table(file).append_column("junk", junk), file, compression="zstd")
    else:
        lance = pytest.importorskip("lance")
        table = lance.dataset(str(path)).to_table().slice(0, 20).append_column("junk", junk)
        lance.write_dataset(table, str(path), mode="overwrite")
    tracemalloc.start()
    with pytest.raises(ValueError) as error:
        open_source(path)
    assert tracemalloc.get_traced_memory()[1] < 128 * MIB  # as objects, half a gigabyte
    tracemalloc.stop()
    assert "first row takes" in one_line(error, "table.lance")


def test_a_chunk_of_gigabytes_is_not_unpacked_for_one_row(tmp_path, make_rows):
    h5py = pytest.importorskip("h5py")
    path = write_swm_hdf5(tmp_path / "x.h5", make_rows([20, 20]))
    with h5py.File(path, "r+") as file:
        shape = file["pixels"].shape
        del file["pixels"]
        file.create_dataset("pixels", shape, "u1", maxshape=(None, *shape[1:]), chunks=(2**20, *shape[1:]), compression="gzip")
    with pytest.raises(KeyError) as error:
        open_source(path)
    assert "chunks of 805306368 bytes" in one_line(error, "x.h5")


def test_a_pipe_in_place_of_a_file_does_not_wait(tmp_path, make_rows):
    os.mkfifo(tmp_path / "x.h5")
    with pytest.raises(ValueError, match="a pipe or a device"):
        open_source(tmp_path / "x.h5")
    path = write_lerobot(tmp_path / "robot", make_rows([20, 20]))
    os.mkfifo(path / "data/chunk-000/file-009.parquet")
    with pytest.raises(ValueError, match="no regular file"):
        open_source(path)
    (path / "data/chunk-000/file-009.parquet").unlink()
    (path / "meta/episodes").mkdir()
    os.mkfifo(path / "meta/episodes/file-000.parquet")  # it only helps to find torn episodes
    assert read_all(path, allow_incomplete=True) == 2


@pytest.mark.parametrize("seed", range(3))
def test_flipped_bytes_never_end_in_anything_but_one_line(tmp_path, make_rows, layout, write, seed):
    rng = np.random.default_rng(seed)
    path = write[layout](tmp_path, make_rows([20, 20], dims=4))
    files = sorted(file for file in path.rglob("*") if file.is_file()) or [path]
    kept = {file: file.read_bytes() for file in files}
    for _ in range(6):
        file = files[rng.integers(len(files))]
        content = bytearray(kept[file])
        for place in rng.integers(len(content), size=3):
            content[place] ^= 1 << rng.integers(8)
        file.write_bytes(content)
        try:
            read_all(path)
        except (ValueError, KeyError) as error:
            text = str(error.args[0])
            assert path.name in text and "\n" not in text
        file.write_bytes(kept[file])
