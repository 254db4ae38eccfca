"""Small files in the layouts of other projects, written by hand."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest

SIZE = 16


def write_lewm(path: Path, rows: dict[str, np.ndarray], *, ids: str = "ep_idx") -> Path:
    """The official files: paged, latest library version, frames in chunks of 100 under Blosc lz4 level 5 + shuffle."""
    h5py, hdf5plugin = pytest.importorskip("h5py"), pytest.importorskip("hdf5plugin")
    blosc = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)
    with h5py.File(path, "w", libver="latest", fs_strategy="page", fs_page_size=4 * 2**20) as file:
        for name, data in rows.items():
            name = ids if name == "ep_idx" else name
            if name == "ep_len":
                file.create_dataset("ep_len", data=data.astype(np.int32), maxshape=(None,))
                file.create_dataset("ep_offset", data=(data.cumsum() - data).astype(np.int64), maxshape=(None,))
            elif data.ndim > 2:
                shape = (100, *data.shape[1:])
                file.create_dataset(name, data=data, chunks=shape, maxshape=(None, *data.shape[1:]), **blosc)
            else:
                data = data.astype(np.int32) if name == ids else data
                file.create_dataset(name, data=data, chunks=(1000, *data.shape[1:]), maxshape=(None, *data.shape[1:]))
        text = ["cube"] * len(rows["ep_idx"])
        file.create_dataset("privileged_target_task", data=text, dtype=h5py.string_dtype())
        file.create_dataset("success", data=np.full(len(text), np.nan))
    return path


def write_swm_hdf5(path: Path, rows: dict[str, np.ndarray]) -> Path:
    """Current stable-worldmodel: chunks of one row, no compression, no episode of a row, ``a/b`` becomes a group."""
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("hdf5plugin")
    with h5py.File(path, "w") as file:
        for name, data in rows.items():
            if name == "ep_len":
                file.create_dataset("ep_len", data=data.astype(np.int32))
                file.create_dataset("ep_offset", data=(data.cumsum() - data).astype(np.int64))
            elif name != "ep_idx":
                file.create_dataset(name, data=data, chunks=(1, *data.shape[1:]))
    return path


def encode(frame: np.ndarray, kind: str = "JPEG") -> bytes:
    """One picture as bytes."""
    image = pytest.importorskip("PIL.Image")
    buffer = io.BytesIO()
    image.fromarray(frame).save(buffer, kind, **({"quality": 95} if kind == "JPEG" else {}))
    return buffer.getvalue()


def write_lance(path: Path, rows: dict[str, np.ndarray]) -> Path:
    """stable-worldmodel's default: int32 indices, JPEG quality 95, everything else float32 lists."""
    lance, arrow = pytest.importorskip("lance"), pytest.importorskip("pyarrow")
    columns = {"episode_idx": arrow.array(rows["ep_idx"], arrow.int32())}
    columns["step_idx"] = arrow.array(rows["step_idx"], arrow.int32())
    columns["pixels"] = arrow.array([encode(frame) for frame in rows["pixels"]], arrow.binary())
    for name in rows.keys() - {"ep_idx", "step_idx", "ep_len", "pixels"}:
        flat = rows[name].reshape(len(rows[name]), -1).astype(np.float32)
        columns[name] = arrow.FixedSizeListArray.from_arrays(arrow.array(flat.reshape(-1)), flat.shape[1])
    lance.write_dataset(arrow.table(columns), str(path))
    return path


def write_ogbench(path: Path, rows: dict[str, np.ndarray], *, visual: bool = True) -> Path:
    """Compressed archive: terminals mark the row of the last observation, whose action is that of another step."""
    terminals = np.zeros(len(rows["action"]), np.float32)
    terminals[rows["ep_len"].cumsum() - 1] = 1
    action = np.nan_to_num(rows["action"], nan=0.7)
    observations = rows["pixels"] if visual else rows["state"].astype(np.float32)
    qpos, qvel = np.split(rows["state"].astype(np.float32), [2], axis=1)
    np.savez_compressed(path, observations=observations, actions=action, terminals=terminals, qpos=qpos, qvel=qvel)
    return path


def write_lerobot(path: Path, rows: dict[str, np.ndarray], *, files: int = 2, video: bool = False) -> Path:
    """Parquet with image structs, several episodes in a file, row groups that cut through episodes."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (path / "meta").mkdir(parents=True)
    (path / "data" / "chunk-000").mkdir(parents=True)
    features = {"action": {"dtype": "float32", "shape": [2]}, "observation.state": {"dtype": "float32", "shape": [2]}}
    features["observation.images.top"] = {"dtype": "video" if video else "image", "shape": [SIZE, SIZE, 3]}
    total = len(rows["action"])
    info = {"codebase_version": "v3.0", "total_frames": total, "total_episodes": len(rows["ep_len"])}
    (path / "meta" / "info.json").write_text(json.dumps({**info, "features": features, "fps": 10}))
    ends = np.cumsum(rows["ep_len"])
    cuts = [0, *ends[np.linspace(0, len(ends) - 1, files + 1).astype(int)[1:]]]
    for number, (start, stop) in enumerate(zip(cuts, cuts[1:])):
        columns = {
            "action": arrow.array(np.nan_to_num(rows["action"][start:stop]).tolist(), arrow.list_(arrow.float32())),
            "observation.state": arrow.array(
                rows["state"][start:stop].tolist(), arrow.list_(arrow.float32(), rows["state"].shape[1])
            ),
            "episode_index": arrow.array(rows["ep_idx"][start:stop], arrow.int64()),
            "frame_index": arrow.array(rows["step_idx"][start:stop], arrow.int64()),
            "task": arrow.array(["push"] * (stop - start)),
        }
        if not video:
            cells = [{"bytes": encode(frame, "PNG"), "path": "x.png"} for frame in rows["pixels"][start:stop]]
            columns["observation.images.top"] = arrow.array(cells)
        file = path / "data" / "chunk-000" / f"file-{number:03d}.parquet"
        parquet.write_table(arrow.table(columns), file, row_group_size=17)
    return path


WRITERS = {
    "lewm": lambda path, rows: write_lewm(path / "official.h5", rows),
    "swm": lambda path, rows: write_swm_hdf5(path / "current.h5", rows),
    "lance": lambda path, rows: write_lance(path / "table.lance", rows),
    "ogbench": lambda path, rows: write_ogbench(path / "visual.npz", rows),
    "lerobot": lambda path, rows: write_lerobot(path / "robot", rows),
}
