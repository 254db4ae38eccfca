"""Lance tables as stable-worldmodel writes them by default."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchrl_ficreg.data.convert.arrow import describe, to_array
from torchrl_ficreg.data.convert.table import bounds_from_ids, check_steps, require, Table

EPISODE_IDS, STEPS = ("episode_idx", "ep_idx"), "step_idx"


class LanceTable(Table):
    """Rows with ``episode_idx`` and ``step_idx``, frames as JPEG bytes, numbers as float32 lists.

    Frames lost a little to JPEG and states were rounded to float32 when the table was written; both stay so.

    Args:
        path: the ``.lance`` folder.

    Raises:
        ImportError: lance is missing.
        ValueError: the folder is damaged, or its rows do not say which episode they belong to.
    """

    format = "lance"

    def __init__(self, path: Path) -> None:
        lance = require("lance", "pylance")
        try:
            self._dataset = lance.dataset(str(path))
            rows = self._dataset.count_rows()
            head = self._dataset.to_table(limit=1)
        except (OSError, ValueError) as error:
            raise ValueError(f"{path} cannot be opened ({error}): it is damaged, or no Lance table.") from error
        cells = head.to_pylist()[0] if rows else {}
        columns = {field.name: describe(field.type, cells.get(field.name), rows) for field in head.schema}
        ids = next((name for name in EPISODE_IDS if name in columns), None)
        if ids is None:
            raise ValueError(
                f"{path} has no column {' or '.join(EPISODE_IDS)}, got {sorted(columns)}: read the columns yourself "
                "and use from_arrays(..., lengths=...)."
            )
        bounds = bounds_from_ids(self._column(ids), path)
        if STEPS in columns:
            check_steps(self._column(STEPS), bounds, path)
        super().__init__(path, columns, *bounds)

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Reads, and decodes, rows of a column; see :meth:`Table.read`."""
        rows = self._dataset.to_table(columns=[name], offset=start, limit=stop - start)
        return to_array(rows.column(0), self.columns[name])

    def _column(self, name: str) -> np.ndarray:
        return self._dataset.to_table(columns=[name]).column(0).to_numpy()
