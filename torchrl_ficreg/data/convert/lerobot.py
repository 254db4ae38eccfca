"""LeRobot folders: parquet files and a description in ``meta/``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg._utils import MOST_JSON_BYTES, read_bytes
from torchrl_ficreg.data.convert._arrow import describe, first_cells, require_arrow, split, to_array
from torchrl_ficreg.data.convert.table import Bounds, bounds_from_ids, brief, check_inside, check_steps, some, Table

INFO = "meta/info.json"
EPISODE_IDS, STEPS = "episode_index", "frame_index"
_BATCH_ROWS = 256  # rows held in memory at once while a row group is read


class LeRobotTable(Table):
    """``data/**/*.parquet`` with ``episode_index``, ``frame_index`` and the features of ``meta/info.json``.

    Both versions of the format are read: one file per episode, and files of many episodes. Frames must be image columns
    (encoded bytes in the table); a data set with its frames in video files has to be exported with images first.

    Args:
        path (Path): the folder.

    Keyword Args:
        allow_incomplete (bool, optional): take the whole episodes of the files that can be read. Default: ``False``.

    Raises:
        ImportError: pyarrow, which is installed with pylance, is missing.
        ValueError: frames are in video files only, a file is damaged, or rows are missing.
    """

    format = "lerobot"

    def __init__(self, path: Path, *, allow_incomplete: bool = False) -> None:
        self._parquet = require_arrow("pyarrow.parquet")
        # Hidden files do not belong to it, such as the ._ files that macOS writes beside every file on some disks.
        found = sorted((path / "data").rglob("*.parquet"))
        files = [file for file in found if not any(part.startswith(".") for part in file.relative_to(path).parts)]
        if not files:
            raise ValueError(f"{path} has no data/**/*.parquet: the download is incomplete, fetch it again.")
        info = _read_info(path)
        self.notices, self._files = [], []
        try:
            self._open(path, files, info, allow_incomplete)
        except BaseException:
            self.close()
            raise

    def _open(self, path: Path, files: list[Path], info: dict[str, Any], allow_incomplete: bool) -> None:
        torn = 0
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        for file in files:
            check_inside(file, path)
            try:
                opened = self._parquet.ParquetFile(file)
                columns = opened.read([EPISODE_IDS, STEPS])
                parts.append(tuple(columns.column(name).to_numpy() for name in (EPISODE_IDS, STEPS)))
            except Exception as error:  # Arrow's own errors, and what broken sizes lead to
                if not allow_incomplete:
                    raise ValueError(
                        f"{file} cannot be read ({brief(error, 80)}): it is damaged or its recording was interrupted: "
                        "fetch or record it again, or pass allow_incomplete=True to leave it out."
                    ) from error
                torn += 1
                continue
            self._files.append(opened)
        if not self._files:
            raise ValueError(f"{path}: none of its {len(files)} parquet files can be read: fetch it again.")
        if torn:
            self.notices.append(f"{torn} of {len(files)} files cannot be read and are left out")
        total = sum(file.metadata.num_rows for file in self._files)
        expected = info.get("total_frames", total)
        if expected != total and not allow_incomplete:
            raise ValueError(
                f"{path} is incomplete: {INFO} promises {expected} rows, found {total}: fetch it again, or pass "
                "allow_incomplete=True to take the whole episodes."
            )
        ids, steps = (np.concatenate(columns) for columns in zip(*parts))
        bounds = bounds_from_ids(ids, path)
        if allow_incomplete:
            bounds = self._whole(bounds, ids, steps, path)
            promised = info.get("total_episodes")
            if isinstance(promised, int) and promised > len(bounds.lengths):
                self.notices.append(f"{promised - len(bounds.lengths)} of {promised} episodes are missing or incomplete")
        else:
            check_steps(steps, bounds, path)
        groups = [
            (file, group, file.metadata.row_group(group).num_rows)
            for file in self._files
            for group in range(file.metadata.num_row_groups)
        ]
        head = next(self._files[0].iter_batches(batch_size=1), None)
        # Where every row group of every file begins, counted over all files.
        self._groups = [(file, group) for file, group, _ in groups]
        self._group_starts = np.cumsum([0, *(count for _, _, count in groups)])
        cells = first_cells(head)
        schema = self._files[0].schema_arrow
        columns, self.left_out = split(
            {field.name: describe(field.type, cells.get(field.name), total) for field in schema}
        )
        if not any(column.kind == "image" for column in columns.values()):
            _refuse_videos(path, info)
        super().__init__(path, columns, *bounds)

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows of a column, which may lie in several row groups; see :meth:`Table.read`."""
        arrow = require_arrow("pyarrow")
        first = int(np.searchsorted(self._group_starts, start, side="right")) - 1
        pieces: list[Any] = []
        for place in range(first, len(self._groups)):
            row = int(self._group_starts[place])
            if row >= stop:
                break
            file, group = self._groups[place]
            for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=[name]):
                low, high = max(start - row, 0), min(stop - row, len(batch))
                if low < high:
                    pieces.append(batch.column(0).slice(low, high - low))
                row += len(batch)
                if row >= stop:
                    break
        return to_array(arrow.chunked_array(pieces), self.columns[name], start)

    def _whole(self, bounds: Bounds, ids: np.ndarray, steps: np.ndarray, path: Path) -> Bounds:
        """The episodes whose steps count up from 0 and, where their length is declared, to the last."""
        declared = _declared_lengths(path, self._parquet)
        kept = []
        for start, length in zip(*bounds):
            counted = np.array_equal(steps[start : start + length], np.arange(length))
            kept.append(counted and declared.get(int(ids[start]), length) == length)
        if not any(kept):
            raise ValueError(f"{path} holds no whole episode: fetch or record it again.")
        if not all(kept):
            self.notices.append(f"{len(kept) - sum(kept)} incomplete episodes are left out")
        return Bounds(bounds.starts[kept], bounds.lengths[kept])

    def close(self) -> None:
        """Closes the files."""
        for file in self._files:
            file.close()


def _read_info(path: Path) -> dict[str, Any]:
    check_inside(path / INFO, path)
    try:
        info = json.loads(read_bytes(path / INFO, most=MOST_JSON_BYTES).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path / INFO} is no JSON object ({brief(error)}): fetch the data set again.") from error
    if not isinstance(info, dict):
        raise ValueError(f"{path / INFO} is no JSON object, but a {type(info).__name__}: fetch the data set again.")
    rows = info.get("total_frames", 0)
    if not isinstance(rows, int) or isinstance(rows, bool) or rows < 0:
        raise ValueError(f"{path / INFO}: total_frames must be a number of rows, got {brief(rows)!r}: fetch it again.")
    return info


def _declared_lengths(path: Path, parquet: Any) -> dict[int, int]:
    """Episode -> declared number of rows, from either version of the format; empty where it cannot be read."""
    lengths: dict[int, int] = {}
    try:
        if (path / "meta/episodes.jsonl").is_file():
            check_inside(path / "meta/episodes.jsonl", path)
            for line in read_bytes(path / "meta/episodes.jsonl", most=MOST_JSON_BYTES).decode().splitlines():
                episode = json.loads(line)
                lengths[int(episode[EPISODE_IDS])] = int(episode["length"])
        for file in sorted((path / "meta/episodes").rglob("[!.]*.parquet")):
            check_inside(file, path)
            columns = parquet.read_table(file, columns=[EPISODE_IDS, "length"]).to_pydict()
            lengths.update(zip(columns[EPISODE_IDS], columns["length"]))
    except Exception:  # the lengths only help to find incomplete episodes
        return lengths
    return lengths


def _refuse_videos(path: Path, info: dict[str, Any]) -> None:
    features = info.get("features")
    features = features if isinstance(features, dict) else {}
    kinds = {name: feature.get("dtype") for name, feature in features.items() if isinstance(feature, dict)}
    videos = sorted(name for name, kind in kinds.items() if kind == "video")
    if videos:
        raise ValueError(
            f"{path} keeps {some(videos, 2)} in video files, which this package does not decode: record or export "
            "the data set with images (use_videos=False in lerobot), or decode the frames with a library of your "
            "choice and use from_arrays()."
        )
