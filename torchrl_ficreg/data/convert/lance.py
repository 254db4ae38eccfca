"""Lance tables, the default format of stable-worldmodel."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

import numpy as np

from torchrl_ficreg._utils import require
from torchrl_ficreg.data.convert._arrow import describe, first_cells, split, to_array
from torchrl_ficreg.data.convert.table import bounds_from_ids, check_inside, check_steps, some, Table

EPISODE_IDS, STEPS = ("episode_idx", "ep_idx"), "step_idx"


class LanceTable(Table):
    """Rows with ``episode_idx`` and ``step_idx``, frames as JPEG bytes, numbers as float32 lists.

    The table itself is lossy: frames went through JPEG, and states were rounded to float32. Both are read as they are.

    Args:
        path (Path): the ``.lance`` folder.

    Raises:
        ImportError: lance is missing.
        ValueError: the folder is damaged, or its rows do not say which episode they belong to.
    """

    format = "lance"

    def __init__(self, path: Path) -> None:
        lance = require("lance", "data", purpose="Lance", package="pylance")
        for folder, _, files in os.walk(path):
            for file in files:
                check_inside(Path(folder, file), path)
        self._dataset = lance.dataset(str(path))
        parts = [file for fragment in self._dataset.get_fragments() for file in fragment.metadata.files]
        # A manifest may name other folders, or addresses in the network, where its data lies.
        if self._dataset.base_paths() or any(file.base_id is not None or not _is_plain(file.path) for file in parts):
            raise ValueError(f"{path} keeps rows outside of its folder, which is not followed: copy the table as a whole.")
        rows = self._dataset.count_rows()
        head = self._dataset.to_table(limit=1)
        cells = first_cells(head)
        columns, self.left_out = split(
            {field.name: describe(field.type, cells.get(field.name), rows) for field in head.schema}
        )
        ids = next((name for name in EPISODE_IDS if name in columns), None)
        if ids is None:
            raise ValueError(
                f"{path} has no column {' or '.join(EPISODE_IDS)}, got {some(sorted(columns))}: read the columns yourself "
                "and use from_arrays(..., lengths=...)."
            )
        bounds = bounds_from_ids(self._column(ids), path)
        if STEPS in columns:
            check_steps(self._column(STEPS), bounds, path)
        super().__init__(path, columns, *bounds)

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads, and decodes, rows of a column; see :meth:`Table.read`."""
        rows = self._dataset.to_table(columns=[name], offset=start, limit=stop - start)
        return to_array(rows.column(0), self.columns[name], start)

    def _column(self, name: str) -> np.ndarray:
        return self._dataset.to_table(columns=[name]).column(0).to_numpy()


def _is_plain(name: str) -> bool:
    """Whether a data file lies in the folder of its table."""
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and "://" not in name
