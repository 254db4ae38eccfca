"""Columns of Arrow tables, as Lance and Parquet files hold them, turned into arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.images import decode
from torchrl_ficreg.data.convert.table import Column, require


_MOST_ROW_BYTES = 64 * 2**20  # of one row; a small file can declare lists that fill the memory


def describe(kind: Any, cell: Any, rows: int) -> Column | str:
    """Says what an Arrow column holds, or why it cannot be read.

    Args:
        kind: its ``pyarrow.DataType``.
        cell: its first value, a Python object.
        rows: how many there are.
    """
    picture = picture_bytes(cell)
    if picture is not None:
        try:
            return Column(decode([picture]).shape[1:], "image", rows)
        except ValueError as error:
            return f"holds no frames: {error}"
    types = require("pyarrow", "pylance").types
    shape: list[int] = []
    while isinstance(cell, list):
        shape.append(len(cell))
        kind, cell = kind.value_type, cell[0] if cell else None
    number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
    return Column(tuple(shape), "number" if number else "text", rows)


def first_cells(head: Any) -> dict[str, Any]:
    """The first value of every column, as Python objects; empty where there is no row.

    Args:
        head: at most one row, a ``RecordBatch`` or ``Table``.

    Raises:
        ValueError: the row is too large for that: as objects, numbers take eight times their size.
    """
    if head is None or not len(head):
        return {}
    if head.nbytes > _MOST_ROW_BYTES:
        raise ValueError(f"its first row takes {head.nbytes} bytes, expected at most {_MOST_ROW_BYTES}: write smaller columns")
    return head.to_pylist()[0]


def picture_bytes(cell: Any) -> bytes | None:
    """The encoded picture in a cell: bytes, or a dictionary that holds them, as ``datasets`` writes it."""
    if isinstance(cell, dict):
        cell = cell.get("bytes")
    return cell if isinstance(cell, bytes) else None


def split(columns: dict[str, Column | str]) -> tuple[dict[str, Column], dict[str, str]]:
    """The columns that can be read, and why others cannot."""
    readable = {name: column for name, column in columns.items() if isinstance(column, Column)}
    return readable, {name: reason for name, reason in columns.items() if isinstance(reason, str)}


def to_array(values: Any, column: Column, first_row: int = 0) -> np.ndarray:
    """Turns a ``ChunkedArray`` into an array.

    Args:
        values: L values of a column.
        column: what :func:`describe` said of it.
        first_row: row of the first value, for messages. Default: 0.

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
    compute = require("pyarrow.compute", "pylance")
    for width in column.shape:
        # Compared one by one: a short list and a long one may add up to the right number of values.
        widths = compute.unique(compute.list_value_length(flat)).to_pylist()
        if widths not in ([width], []):
            raise ValueError(f"lists of {width} values were expected, got lengths {widths[:8]}")
        flat = flat.flatten()
    return flat.to_numpy(zero_copy_only=False).reshape(len(values), *column.shape)
