"""Files that somebody made, or damaged, so that reading them does harm: each is refused in one line that names it.

Only JPEG, PNG and WebP are opened as pictures; nothing outside of a file or folder is read; sizes that are declared but not
there are refused before memory is asked for.
"""

from __future__ import annotations

import io
import json
import os
import tracemalloc
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from foreign_files import encode, SIZE, write_lance, write_lerobot, write_ogbench, write_swm_hdf5

from torchrl_ficreg.data.convert import open_source
from torchrl_ficreg.data.convert.images import decode
from torchrl_ficreg.data.convert.table import reading

h5py = pytest.importorskip("h5py", reason="most of the files are HDF5")
MIB = 2**20
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 16\n%%EndComments\nshowpage\n%%EOF\n"


def read_all(path: Path, **options) -> int:
    """Opens a source and reads every episode."""
    with open_source(path, **options) as source:
        for index in range(len(source)):
            source.episode(index)
        return len(source)


@contextmanager
def refused(name: str, *words: str, memory: int = 0):
    """An error of one line, which is not long, names the file and holds one of the words; and the memory it may take."""
    if memory:
        tracemalloc.start()
    with pytest.raises((ValueError, KeyError)) as error:
        yield
    if memory:
        assert tracemalloc.get_traced_memory()[1] < memory
        tracemalloc.stop()
    text = str(error.value.args[0])
    assert name in text and "\n" not in text and len(text) < 450, text
    assert not words or any(word in text for word in words), text


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
    with refused("table"):
        read_all(writer(tmp_path / "table", rows), state="state" if writer is write_lance else None)
    assert not mark.exists()


SECRET = b"-----BEGIN PRIVATE KEY-----" * 40_000


def external_storage(file, name, data, secret):
    file.create_dataset(name, shape=data.shape, dtype=data.dtype, external=[(str(secret), 0, data.nbytes)])


def other_file(secret, data):
    """A file beside the secret that holds the data as ``x``."""
    with h5py.File(secret.with_name("other.h5"), "w") as other:
        other["x"] = data
    return str(secret.with_name("other.h5"))


def virtual(file, name, data, source, entry):
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource(source, entry, data.shape)
    file.create_virtual_dataset(name, layout)


def virtual_file(file, name, data, secret):
    virtual(file, name, data, other_file(secret, data), "x")


def virtual_chain(file, name, data, secret):
    """Virtual over a virtual one of this file, which is over another file."""
    virtual_file(file, "between", data, secret)
    virtual(file, name, data, ".", "between")


def external_link(file, name, data, secret):
    file[name] = h5py.ExternalLink(other_file(secret, data), "x")


def link_to_a_link(file, name, data, secret):
    external_link(file, "between", data, secret)
    file[name] = h5py.SoftLink("/between")


@pytest.mark.parametrize("column", ["pixels", "action", "ep_len", "ep_idx"])
@pytest.mark.parametrize("way", [external_storage, virtual_file, virtual_chain, external_link, link_to_a_link])
def test_a_file_reads_no_other_file(tmp_path, make_rows, way, column):
    """Frames made of somebody's private key would be handed on with the dataset."""
    secret, rows = tmp_path / "secret", make_rows([20, 20])
    secret.write_bytes(SECRET)
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    with h5py.File(path, "r+") as file:
        if column == "ep_idx":  # with nothing else that says where the episodes are
            del file["ep_len"], file["ep_offset"]
        elif column in file:
            del file[column]
        way(file, column, rows[column], secret)
    with refused("x.h5", *(() if column == "ep_idx" else ("not followed", "no array of this file"))):
        read_all(path)


def test_what_is_not_followed_does_not_refuse_the_rest(tmp_path, make_rows):
    rows = make_rows([20, 20])
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    (tmp_path / "secret").write_bytes(SECRET)
    with h5py.File(path, "r+") as file:
        for number, way in enumerate((external_storage, virtual_file, external_link, link_to_a_link)):
            way(file.create_group(f"part{number}"), "depth", rows["action"], tmp_path / "secret")
        file["loop"], file["nowhere"], file["self"] = h5py.SoftLink("/loop"), h5py.SoftLink("/part9/depth"), file["/"]
    assert read_all(path) == 2


def test_links_and_virtual_data_sets_within_a_file_are_columns(tmp_path, make_rows, expected):
    rows = make_rows([20, 20])
    want = expected(rows)
    path = write_swm_hdf5(tmp_path / "x.h5", rows)
    with h5py.File(path, "r+") as file:
        file.move("pixels", "raw/cam0/rgb")
        file["camera"] = h5py.SoftLink("/raw/cam0")  # of a group
        file["pixels"] = h5py.SoftLink("camera/rgb")  # relative, through the other link
        file.move("action", "raw/action")
        virtual(file, "action", rows["action"], ".", "raw/action")
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
            with refused(file.name, "leads out of"):
                read_all(path)
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
    with refused("table.lance", "outside of its folder"):
        open_source(path)


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
    with refused("", "declares", "cannot be decoded", memory=64 * MIB):
        decode(cells)


def unwritten(shape, dtype):
    """Declared, in chunks of eight, and never written."""
    return {"shape": shape, "dtype": dtype, "chunks": (8, *(min(size, 8) for size in shape[1:]))}


def given(*values):
    return {"data": np.array(values)}


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        *[("", {name: unwritten((2**40,), "i8")}) for name in ("ep_len", "ep_offset")],
        *[("", {"ep_len": given(first, 20)}) for first in (-3, 12.7, np.nan, b"12")],
        *[("", {"ep_len": given(rows, rows)}) for rows in (10**9, 2**62)],
        *[("", {"ep_offset": given(*starts)}) for starts in ((0, 2**62), (0,))],
        ("", {"pixels": unwritten((40, 100_000, 100_000, 3), "u1")}),
        ("", {"action": unwritten((40, 10**9), "f4")}),
        (
            "more than are read at once",
            {
                "pixels": {**unwritten((10**9, 16, 16, 3), "u1"), "chunks": (1024, 16, 16, 3)},
                "action": {**unwritten((10**9, 2), "f4"), "chunks": (1024, 2)},
                "state": {**unwritten((10**9, 2), "f8"), "chunks": (1024, 2)},
                "ep_len": given(10**9),
                "ep_offset": given(0),
            },
        ),
        (
            "chunks of 805306368 bytes",
            {"pixels": {**unwritten((40, 16, 16, 3), "u1"), "chunks": (2**20, 16, 16, 3), "maxshape": (None, 16, 16, 3)}},
        ),
    ],
)
def test_hdf5_sizes_are_compared_before_memory_is_asked_for(tmp_path, make_rows, words, changes):
    path = write_swm_hdf5(tmp_path / "x.h5", make_rows([20, 20]))
    with h5py.File(path, "r+") as file:
        for column, options in changes.items():
            del file[column]
            file.create_dataset(column, **options, **({"compression": "gzip"} if "maxshape" in options else {}))
    with refused("x.h5", words, memory=64 * MIB):
        read_all(path)


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
        with refused(f"{member}.npz"):
            read_all(tmp_path / f"{member}.npz")


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
    with refused("robot"):
        read_all(path)


@pytest.mark.parametrize("kind", [RuntimeError, AttributeError, MemoryError, OverflowError, RecursionError, "PanicException"])
def test_whatever_a_library_raises_names_the_file(kind):
    """Libraries written in Rust report damage by a class of their own, which is no Exception."""
    if isinstance(kind, str):
        kind = type(kind, (BaseException,), {"__module__": "pyo3_runtime"})
    with refused("some/file.h5"), reading(Path("some/file.h5")):
        raise kind("a\nb" * 500)


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
    with refused("robot", "8 bits"):
        open_source(path)


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
    with refused("table.lance", "first row takes", memory=128 * MIB):  # as objects, half a gigabyte
        open_source(path)


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
