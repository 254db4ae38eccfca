"""Conversion of a source file to a dataset, episode by episode."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from torchrl_ficreg._utils import require_space
from torchrl_ficreg.data.convert.alignment import Alignment, EXPLAINED, measure_alignment
from torchrl_ficreg.data.convert.formats import open_source
from torchrl_ficreg.data.convert.source import EpisodeSource, TASKS
from torchrl_ficreg.data.frames import check_frame_format, encode_frames, FrameFormat
from torchrl_ficreg.data.layout import estimate_bytes, META_FILE
from torchrl_ficreg.data.writer import EpisodeWriter
from torchrl_ficreg.keys import PIXELS

_SAMPLED_EPISODES = 50
_ROWS_PER_NUMBER = 20  # fewer rows per action component do not suffice for the fit


def convert(
    source: str | Path | EpisodeSource,
    target: str | Path,
    *,
    env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    action_bounds: tuple[Sequence[float], Sequence[float]] | None = None,
    frames: FrameFormat = "raw",
    image_size: int | None = None,
    limit: int | None = None,
    check_alignment: bool = True,
    skip_bad_episodes: bool = False,
    progress: bool = True,
) -> Path:
    """Converts data of another format to a dataset of this package.

    One episode at a time is in memory. A conversion that was killed continues when it is called again with the same
    arguments, with the same bytes as a result. The alignment of actions and states and the free disk space are checked
    before anything is written.

    Args:
        source (str, Path or EpisodeSource): a file or folder, opened by :func:`open_source`, or an opened source.
        target (str or Path): directory of the dataset.

    Keyword Args:
        env (str, optional): ``"two_room"``, ``"push_t"``, ``"reacher"``, ``"cube"``, or any name for other data.
            Default: that of the source.
        env_kwargs (dict, optional): arguments of the environment that the data came from, stored with the dataset.
            Default: ``None``, none.
        action_bounds (pair of sequences, optional): lowest and highest action, two vectors [A], stored for planning.
            Default: -1 and 1 for the four environments; otherwise the smallest and largest action in the file.
        frames (str, optional): ``"raw"``, or compressed one by one as ``"webp"`` or ``"png"``. Default: ``"raw"``.
        image_size (int, optional): pixels of a side to which frames are scaled; frames that are not square are
            squeezed, with a warning. Default: ``None``, as they are.
        limit (int, optional): largest number of episodes, from the first. Default: ``None``, all.
        check_alignment (bool, optional): refuse a file whose actions are stored in the wrong rows. Default: ``True``.
        skip_bad_episodes (bool, optional): leave out the episodes that are damaged, or hold a NaN or an infinity, and
            warn with their number. Reads the data twice. Default: ``False``.
        progress (bool, optional): show a bar with frames per second and the remaining time. Default: ``True``.

    Returns:
        the directory.

    Raises:
        FileNotFoundError, ImportError, KeyError: see :func:`open_source`.
        OSError: the disk is too small.
        ValueError: the file is damaged or its actions are shifted (the message names the lag), an argument is out of
            range, or the directory holds other data.

    Examples:
        >>> import tempfile
        >>> from torchrl_ficreg.data import OfflineTrajectories
        >>> from torchrl_ficreg.data.convert import from_arrays
        >>> rng = np.random.default_rng(0)
        >>> action = rng.uniform(-1, 1, (600, 2))
        >>> source = from_arrays(
        ...     pixels=rng.integers(0, 256, (600, 16, 16, 3), dtype=np.uint8),
        ...     action=action,
        ...     state=np.concatenate([np.zeros((1, 2)), action.cumsum(0)[:-1]]),
        ...     lengths=[30] * 20,
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = convert(source, folder, env="mine", image_size=8, progress=False)
        ...     dataset = OfflineTrajectories(path, batch_size=4)
        ...     dataset.sample()["pixels"].shape, dataset.meta["source"]["format"]
        (torch.Size([4, 4, 3, 8, 8]), 'arrays')
    """
    with ExitStack() as opened:
        if not isinstance(source, EpisodeSource):
            source = opened.enter_context(open_source(source, env=env))
        _check_arguments(source, env, frames, image_size, limit)
        if skip_bad_episodes:
            source.leave_out_bad_episodes()
        place = Path(target).expanduser()
        if place.exists() and not place.is_dir():
            raise ValueError(f"target={target} is a file: name a folder.")
        size = (int(image_size), int(image_size)) if image_size else source.frame_shape
        count = min(limit or len(source), len(source))
        if source.skipped:
            warnings.warn(f"{source.table.path}: {source.skipped} episodes of fewer than two rows are left out.")
        for notice in source.notices:
            warnings.warn(f"{source.table.path}: {notice}.")
        _warn_of_shape(source, size)
        if check_alignment and source.state_dim:
            verify_alignment(source)
        low, high = _bounds(source, action_bounds)
        meta = {
            "env": env or source.env or "unknown",
            "env_kwargs": dict(env_kwargs or {}),
            "image_size": size[0] if size[0] == size[1] else list(size),
            "action_low": low,
            "action_high": high,
            "source": source.facts(),
        }
        meta = json.loads(json.dumps(meta, sort_keys=True))  # as it is read back when resuming
        if not (place / META_FILE).exists():  # before the folder is made
            require_space(target, _needed_bytes(source, int(source.lengths[:count].sum()), size, frames))
        with EpisodeWriter(target, target_episodes=count, meta=meta, frames=frames) as writer:
            if not writer.complete:
                if writer.num_episodes:
                    rest = source.lengths[writer.num_episodes : count]
                    require_space(target, _needed_bytes(source, int(rest.sum()), size, frames))
                for episode in _episodes(source, writer.num_episodes, count, size, progress):
                    writer.append(episode)
            writer.finish()
        return writer.path


def _warn_of_shape(source: EpisodeSource, size: tuple[int, int]) -> None:
    """Warns of frames that are not square: the encoders of this package take square ones."""
    height, width = source.frame_shape
    if size[0] != size[1]:
        warnings.warn(
            f"{source.table.path}: frames of {height} x {width} are kept as they are, and the encoders of this package take "
            "square ones: pass image_size= to squeeze them to a square, or cut them before."
        )
    elif height != width:
        warnings.warn(f"{source.table.path}: frames of {height} x {width} are squeezed to {size[0]} x {size[1]}.")


def verify_alignment(source: EpisodeSource) -> Alignment | None:
    """Refuses a source whose actions are stored in the wrong rows.

    Args:
        source (EpisodeSource): the episodes; the fit uses up to 50 of them, evenly distributed.

    Returns:
        the measured alignment, or ``None`` where there are too few rows or no state.

    Raises:
        ValueError: another lag than 0 explains the change of the state clearly better.
        UserWarning: (as a warning) no lag explains it, or there are too few rows.
    """
    if not source.state_dim:
        return None
    chosen = np.unique(np.linspace(0, len(source) - 1, _SAMPLED_EPISODES).astype(int))
    rows = int(source.lengths[chosen].sum())
    if rows < _ROWS_PER_NUMBER * (source.action_dim + 1):
        warnings.warn(f"{source.table.path}: {rows} rows are too few to check that actions and states are aligned.")
        return None
    found = measure_alignment(source.vectors(int(index)) for index in chosen)
    shares = ", ".join(f"{share:.3f} at lag {lag:+d}" for lag, share in found.r2.items())
    explained = f"actions explain of the change ({found.change}) of the state: {shares}"
    names = f"{source.table.path}, {' + '.join(source.columns['action'])} and {' + '.join(source.columns['state'])}"
    if found.lag is None:
        warnings.warn(
            f"{names}: no lag explains more than {EXPLAINED:.0%} ({explained}), so the alignment could not be verified. "
            "Name columns that the actions move directly by state=."
        )
    elif found.lag and (found.change == "difference" or found.lag < 0):
        raise ValueError(
            f"{names} are shifted: the lag is {found.lag:+d} ({explained}). Row t has to hold the action that leads from "
            f"row t to row t + 1: correct it by shift={source.shift + found.lag}, or, if you are sure, pass "
            "check_alignment=False."
        )
    elif found.lag:
        # A force, or a position to be reached, may act one step late without any shift.
        warnings.warn(f"{names}: actions seem to act one row late ({explained}): if they are shifted, pass shift=1.")
    return found


def _check_arguments(
    source: EpisodeSource, env: str | None, frames: str, image_size: int | None, limit: int | None
) -> None:
    if env is not None and env != source.env and (env in TASKS or source.env is not None):
        raise ValueError(f"the source was opened with env={source.env!r}, got env={env!r}: pass env= to open_source().")
    check_frame_format(frames)
    for name, value in (("image_size", image_size), ("limit", limit)):
        if value is not None and (not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1):
            raise ValueError(f"{name} must be an integer of at least 1, got {value!r}.")


def _bounds(
    source: EpisodeSource, given: tuple[Sequence[float], Sequence[float]] | None
) -> tuple[list[float], list[float]]:
    if given is not None:
        low, high = (np.asarray(bound, float).reshape(-1) for bound in given)
        fits = low.shape == high.shape == (source.action_dim,) and np.isfinite([low, high]).all()
        if not fits or not (low <= high).all():
            raise ValueError(
                f"action_bounds must be two vectors of {source.action_dim} numbers, lowest first, got {given}."
            )
    elif source.env in TASKS:
        low, high = -np.ones(source.action_dim), np.ones(source.action_dim)
    else:
        low, high = np.full(source.action_dim, np.inf), np.full(source.action_dim, -np.inf)
        for index in range(len(source)):  # of all episodes, so that a larger limit changes nothing
            action = source.vectors(index)[0][:-1]
            finite = np.where(np.isfinite(action), action, np.nan)  # others are refused when they are read
            low, high = np.fmin(low, np.fmin.reduce(finite)), np.fmax(high, np.fmax.reduce(finite))
        if not (low <= high).all():
            wrong = int(np.flatnonzero(~(low <= high))[0])
            raise ValueError(f"{source.table.path}: no action has a number in component {wrong}: choose another column.")
    return low.tolist(), high.tolist()


def _needed_bytes(source: EpisodeSource, rows: int, size: tuple[int, int], frames: FrameFormat) -> int:
    """Disk space of the remaining rows, in bytes; for compressed frames a quarter above that of a sample.

    :func:`estimate_bytes` alone would be far too low for frames that went through JPEG.
    """
    if frames == "raw":
        return estimate_bytes(rows, size, source.action_dim, source.state_dim)
    numbers = estimate_bytes(rows, 0, source.action_dim, source.state_dim)
    sample = source.episode(0, size)[PIXELS][:: ceil(source.lengths[0] / 16)]
    encoded = sum(map(len, encode_frames(sample, frames)))
    return numbers + ceil(1.25 * rows * encoded / len(sample))


def _episodes(
    source: EpisodeSource, first: int, count: int, size: tuple[int, int], progress: bool
) -> Iterator[dict[str, np.ndarray]]:
    total, done = int(source.lengths[:count].sum()), int(source.lengths[:first].sum())
    settings = {"desc": "convert", "unit": "frame", "dynamic_ncols": True, "disable": not progress}
    with tqdm(total=total, initial=done, **settings) as bar:
        for index in range(first, count):
            yield source.episode(index, size)
            bar.update(int(source.lengths[index]))
