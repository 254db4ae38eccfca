"""Arrow columns, as Lance and Parquet files hold them, converted to arrays."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from torchrl_ficreg._utils import require
from torchrl_ficreg.data.convert.images import decode
from torchrl_ficreg.data.convert.table import Column

_MOST_ROW_BYTES = 64 * 2**20  # of one row; a small file can declare lists that fill the memory


def require_arrow(module: str) -> ModuleType:
    """Imports a module of pyarrow, which is installed with pylance.

    Raises:
        ImportError: it is missing.
    """
    return require(module, "data", purpose="this format", package="pylance")


def describe(kind: Any, cell: Any, rows: int) -> Column | str:
    """Describes an Arrow column, or says why it cannot be read.

    Args:
        kind (pyarrow.DataType): its type.
        cell (object): its first value.
        rows (int): its number of rows.
    """
    picture = picture_bytes(cell)
    if picture is not None:
        try:
            return Column(decode([picture]).shape[1:], "image", rows)
        except ValueError as error:
            return f"holds no frames: {error}"
    types = require_arrow("pyarrow").types
    shape: list[int] = []
    while isinstance(cell, list):
        shape.append(len(cell))
        kind, cell = kind.value_type, cell[0] if cell else None
    number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
    return Column(tuple(shape), "number" if number else "text", rows)


def first_cells(head: Any) -> dict[str, Any]:
    """The first value of every column, as Python objects; empty where there is no row.

    Args:
        head (pyarrow.RecordBatch or pyarrow.Table): at most one row.

    Raises:
        ValueError: the row is too large: as Python objects numbers take eight times their size.
    """
    if head is None or not len(head):
        return {}
    if head.nbytes > _MOST_ROW_BYTES:
        raise ValueError(f"its first row takes {head.nbytes} bytes, expected at most {_MOST_ROW_BYTES}: write smaller columns")
    return head.to_pylist()[0]


def picture_bytes(cell: Any) -> bytes | None:
    """The encoded picture in a cell: bytes, or a dictionary that holds them, as Hugging Face ``datasets`` writes them."""
    if isinstance(cell, dict):
        cell = cell.get("bytes")
    return cell if isinstance(cell, bytes) else None


def split(columns: dict[str, Column | str]) -> tuple[dict[str, Column], dict[str, str]]:
    """Divides what :func:`describe` returned into the columns that can be read and the reasons why others cannot."""
    readable = {name: column for name, column in columns.items() if isinstance(column, Column)}
    return readable, {name: reason for name, reason in columns.items() if isinstance(reason, str)}


def to_array(values: Any, column: Column, first_row: int = 0) -> np.ndarray:
    """Turns a ``ChunkedArray`` into an array.

    Args:
        values (pyarrow.ChunkedArray): L values of a column.
        column (Column): its description by :func:`describe`.
        first_row (int, optional): row of the first value, for messages. Default: ``0``.

    Returns:
        [L, *shape].

    Raises:
        ValueError: a value is missing, or lists differ in length.
    """
    if values.null_count:
        raise ValueError(f"{values.null_count} values are missing")
    if column.kind == "image":
        cells = [picture_bytes(cell) for cell in values.to_pylist()]
        if None in cells:
            raise ValueError("a frame holds no bytes: it refers to a file outside the table")
        return decode(cells, column.shape, first_row=first_row)
    flat = values.combine_chunks()
    compute = require_arrow("pyarrow.compute")
    for width in column.shape:
        # Compared one by one: a short list and a long one may add up to the right number of values.
        widths = compute.unique(compute.list_value_length(flat)).to_pylist()
        if widths not in ([width], []):
            raise ValueError(f"lists of {width} values were expected, got lengths {widths[:8]}")
        flat = flat.flatten()
    return flat.to_numpy(zero_copy_only=False).reshape(len(values), *column.shape)
