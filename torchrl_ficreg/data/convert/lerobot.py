"""LeRobot-style folders: parquet files with a description beside them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.arrow import describe, to_array
from torchrl_ficreg.data.convert.table import bounds_from_ids, check_steps, require, Table

INFO = "meta/info.json"
EPISODE_IDS, STEPS = "episode_index", "frame_index"
_BATCH_ROWS = 256  # of frames held at once while a row group is read


class LeRobotTable(Table):
    """``data/**/*.parquet`` with ``episode_index``, ``frame_index`` and the features of ``meta/info.json``.

    Both generations are read: one file per episode, and files of many episodes. Frames must be image columns
    (encoded bytes in the table); a data set that keeps them in video files has to be exported with images first.

    Args:
        path: the folder.

    Raises:
        ImportError: pyarrow, which comes with pylance, is missing.
        ValueError: frames are in video files only, a file is damaged, or rows are missing.
    """

    format = "lerobot"

    def __init__(self, path: Path) -> None:
        self._parquet = require("pyarrow.parquet", "pylance")
        files = sorted((path / "data").rglob("*.parquet"))
        if not files:
            raise ValueError(f"{path} has no data/**/*.parquet: the download is incomplete, fetch it again.")
        info = _read_info(path)
        try:
            self._files = [self._parquet.ParquetFile(file) for file in files]
            rows = [file.metadata.num_rows for file in self._files]
            # Where every row group of every file begins, counted over all files.
            groups = [
                (file, group, file.metadata.row_group(group).num_rows)
                for file in self._files
                for group in range(file.metadata.num_row_groups)
            ]
            ids = np.concatenate([file.read([EPISODE_IDS]).column(0).to_numpy() for file in self._files])
            steps = np.concatenate([file.read([STEPS]).column(0).to_numpy() for file in self._files])
            head = next(self._files[0].iter_batches(batch_size=1), None)
        except (OSError, ValueError, KeyError, IndexError) as error:
            raise ValueError(f"{path} cannot be read ({error}): a file is damaged, fetch it again.") from error
        self._groups = [(file, group) for file, group, _ in groups]
        self._group_starts = np.cumsum([0, *(count for _, _, count in groups)])
        total = sum(rows)
        expected = info.get("total_frames", total)
        if expected != total:
            raise ValueError(f"{path} is incomplete: {INFO} promises {expected} rows, found {total}: fetch it again.")
        cells = head.to_pylist()[0] if head is not None else {}
        schema = self._files[0].schema_arrow
        columns = {field.name: describe(field.type, cells.get(field.name), total) for field in schema}
        if not any(column.kind == "image" for column in columns.values()):
            _refuse_videos(path, info)
        bounds = bounds_from_ids(ids, path)
        check_steps(steps, bounds, path)
        super().__init__(path, columns, *bounds)

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads rows of a column, which may lie in several row groups; see :meth:`Table.read`."""
        arrow = require("pyarrow")
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
        return to_array(arrow.chunked_array(pieces), self.columns[name])

    def close(self) -> None:
        """Closes the files."""
        for file in self._files:
            file.close()


def _read_info(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((path / INFO).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{path / INFO} is no JSON object ({error}): fetch the data set again.") from error


def _refuse_videos(path: Path, info: dict[str, Any]) -> None:
    features = info.get("features", {})
    videos = sorted(name for name, feature in features.items() if feature.get("dtype") == "video")
    if videos:
        raise ValueError(
            f"{path} keeps {', '.join(videos)} in video files, which this package does not decode: record or export "
            "the data set with images (use_videos=False in lerobot), or decode the frames with a library of your "
            "choice and use from_arrays()."
        )
