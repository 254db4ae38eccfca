"""Arrays of one's own: in memory, memory-mapped, or anything else that can be sliced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ficreg.data.convert.source import EpisodeSource
from torchrl_ficreg.data.convert.table import Column, Table


class ArrayTable(Table):
    """Arrays over all rows, one after another; sliced when read.

    Args:
        arrays: name -> [N, ...].
        lengths: int64 [E], rows of each episode.

    Raises:
        ValueError: the arrays differ in their number of rows, or the lengths do not add up to it.
    """

    format = "arrays"

    def __init__(self, arrays: Mapping[str, Any], lengths: Sequence[int] | np.ndarray) -> None:
        lengths = np.asarray(lengths, np.int64).reshape(-1)
        rows = {name: len(array) for name, array in arrays.items()}
        total = int(lengths.sum())
        if set(rows.values()) != {total} or (lengths < 1).any():
            raise ValueError(
                f"every array needs one row per step: got rows {rows} and episodes of {total} rows in all; check "
                "lengths= or episode_ends= (one past the last row of each episode)."
            )
        self._arrays = dict(arrays)
        columns = {}
        for name, array in arrays.items():
            image = array.dtype == np.uint8 and len(array.shape) >= 3
            columns[name] = Column(tuple(array.shape[1:]), "image" if image else "number", total)
        super().__init__(Path("arrays"), columns, np.cumsum(lengths) - lengths, lengths)

    def read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Slices an array; see :meth:`Table.read`."""
        return np.asarray(self._arrays[name][start:stop])


def from_arrays(
    *,
    pixels: Any,
    action: Any,
    state: Any,
    lengths: Sequence[int] | np.ndarray | None = None,
    episode_ends: Sequence[int] | np.ndarray | None = None,
    env: str | None = None,
    shift: int = 0,
) -> EpisodeSource:
    """Episodes in arrays of one's own.

    Row t holds the frame, the state it was drawn from, and the action that leads to row t + 1. What the last row of
    an episode has as its action is not used.

    Keyword Args:
        pixels: [N, H, W, 3] or [N, 3, H, W] uint8. This and the others may be numpy arrays, ``np.memmap``, or datasets
            of h5py or zarr: anything with ``shape``, ``dtype`` and slices.
        action: [N, A].
        state: [N, S].
        lengths: [E], rows of each episode.
        episode_ends: [E], one past the last row of each episode; instead of ``lengths``.
        env: name of the environment, for the record.
        shift: see :class:`EpisodeSource`.

    Returns:
        What :func:`convert` takes.

    Raises:
        ValueError: lengths that do not fit, wrong shapes or dtypes, or not exactly one of ``lengths`` and
            ``episode_ends``.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> source = from_arrays(
        ...     pixels=rng.integers(0, 256, (50, 8, 8, 3), dtype=np.uint8),
        ...     action=rng.normal(size=(50, 2)),
        ...     state=rng.normal(size=(50, 4)),
        ...     episode_ends=[20, 50],
        ... )
        >>> len(source), source.lengths.tolist()
        (2, [20, 30])
        >>> {key: (value.shape, str(value.dtype)) for key, value in source.episode(0).items()}
        ... # doctest: +NORMALIZE_WHITESPACE
        {'pixels': ((20, 3, 8, 8), 'uint8'), 'action': ((20, 2), 'float32'), 'state': ((20, 4), 'float64')}
    """
    if (lengths is None) == (episode_ends is None):
        raise ValueError("pass exactly one of lengths= (rows of each episode) and episode_ends= (one past the last).")
    if pixels.dtype != np.uint8:
        raise ValueError(f"pixels must be uint8 from 0 to 255, got {pixels.dtype}: scale and convert them first.")
    if lengths is None:
        lengths = np.diff(np.asarray(episode_ends, np.int64), prepend=0)
    table = ArrayTable({"pixels": pixels, "action": action, "state": state}, lengths)
    return EpisodeSource(table, env=env, state=["state"], pixels="pixels", action="action", shift=shift)
