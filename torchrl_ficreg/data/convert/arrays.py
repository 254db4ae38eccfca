"""Episodes in the user's own arrays: in memory, memory-mapped, or anything else that can be sliced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_ficreg.data.convert.source import EpisodeSource
from torchrl_ficreg.data.convert.table import Column, Table


class ArrayTable(Table):
    """Arrays over all rows, one after another; sliced when read.

    Args:
        arrays (dict): name -> [N, ...].
        lengths (sequence of int): [E], rows of each episode.

    Raises:
        ValueError: the arrays differ in their number of rows, or the lengths do not add up to it.
    """

    format = "arrays"

    def __init__(self, arrays: Mapping[str, Any], lengths: Sequence[int] | np.ndarray) -> None:
        lengths = _whole_numbers(lengths, "lengths")
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
    state: Any = None,
    lengths: Sequence[int] | np.ndarray | None = None,
    episode_ends: Sequence[int] | np.ndarray | None = None,
    **source: Any,
) -> EpisodeSource:
    """Episodes in the user's own arrays.

    Row t holds the frame, the state it was drawn from, and the action that leads to row t + 1. The action in the last
    row of an episode is not used.

    Keyword Args:
        pixels (array): [N, H, W, 3] or [N, 3, H, W] uint8. This and the others may be numpy arrays, ``np.memmap``,
            torch tensors, lists, or datasets of h5py or zarr: anything with ``shape``, ``dtype`` and slices.
        action (array): [N, A].
        state (array, optional): [N, S]. No loss reads it, but without it alignment cannot be verified and no
            start-goal pairs can be drawn. Default: ``None``.
        lengths (sequence of int, optional): [E], rows of each episode.
        episode_ends (sequence of int, optional): [E], one past the last row of each episode; instead of ``lengths``.
        **source: ``env``, ``shift`` and ``skip_bad_episodes`` of :class:`EpisodeSource`.

    Returns:
        the episodes, for :func:`convert`.

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
    given = {"pixels": pixels, "action": action, "state": state}
    arrays = {name: _as_array(value, name) for name, value in given.items() if name != "state" or value is not None}
    got = arrays["pixels"]
    if got.dtype != np.uint8 or len(got.shape) != 4:
        raise ValueError(
            f"pixels must be uint8 from 0 to 255 of shape [N, H, W, 3] or [N, 3, H, W], got {got.dtype} of shape "
            f"{list(got.shape)}: scale and convert them first."
        )
    if lengths is None:
        lengths = np.diff(_whole_numbers(episode_ends, "episode_ends"), prepend=0)
    return EpisodeSource(
        ArrayTable(arrays, lengths),
        state=["state"] if state is not None else None,
        pixels="pixels",
        action="action",
        **source,
    )


def _as_array(value: Any, name: str) -> Any:
    """Converts to something with ``shape``, ``dtype`` and slices, without a copy where possible.

    Raises:
        TypeError: it holds no numbers.
    """
    if isinstance(value, torch.Tensor):
        value = _to_numpy(value)
    elif not (hasattr(value, "shape") and hasattr(value, "dtype")):
        try:
            whole = value if isinstance(value, Sequence) else list(value)
            value = np.asarray([_to_numpy(row) for row in whole] if _holds_tensors(whole) else whole)
        except (ValueError, TypeError) as error:
            raise TypeError(f"{name} must be an array of numbers, got a {type(value).__name__} ({error}).") from error
        if name == "pixels" and value.dtype.kind in "iu" and value.size and 0 <= value.min() and value.max() <= 255:
            value = value.astype(np.uint8)
    if not len(value.shape) or np.dtype(value.dtype).kind not in "biuf":
        raise TypeError(f"{name} must be an array of numbers with one row per step, got {value.dtype} {value.shape}.")
    return value


def _holds_tensors(values: Sequence[Any]) -> bool:
    return len(values) > 0 and all(isinstance(value, torch.Tensor) for value in values)


def _to_numpy(value: torch.Tensor) -> np.ndarray:
    value = value.detach().cpu()
    return (value.float() if value.dtype == torch.bfloat16 else value).numpy()


def _whole_numbers(values: Any, name: str) -> np.ndarray:
    values = np.asarray(_as_array(values, name)).reshape(-1)
    with np.errstate(invalid="ignore"):  # of a NaN
        whole = values.astype(np.int64)
    if not np.array_equal(whole, values):
        raise ValueError(f"{name} must be whole numbers of rows, got {values[:4].tolist()}.")
    return whole
