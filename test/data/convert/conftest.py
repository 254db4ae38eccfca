"""Rows whose every frame says which episode and step it belongs to, and what is to become of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_files import SIZE, WRITERS

LENGTHS = [31, 40, 25, 33, 28, 36]


@pytest.fixture
def make_rows() -> Callable[..., dict[str, np.ndarray]]:
    """``make_rows()`` is a table of rows in the official layout: NaN last action, s[t+1] = s[t] + 5 a[t], HWC frames.

    The frame of episode e, step t has the colour (e, t, 0), which no compression changes much.
    """

    def make_rows(lengths=LENGTHS, dims: int = 2, size: int = SIZE, smooth: float = 0.5) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(0)
        parts: dict[str, list[np.ndarray]] = {"pixels": [], "action": [], "state": [], "ep_idx": [], "step_idx": []}
        for number, length in enumerate(lengths):
            action = rng.normal(size=(length, 2))
            for step in range(1, length):  # as experts move: today's action resembles yesterday's
                action[step] = smooth * action[step - 1] + (1 - smooth) * action[step]
            place = 100 + 5 * np.concatenate([np.zeros((1, 2)), action[:-1].cumsum(0)])
            action[-1] = np.nan
            frames = np.zeros((length, size, size, 3), np.uint8)
            frames[..., 0], frames[..., 1] = 10 * number % 256, np.arange(length)[:, None, None] * 3
            parts["pixels"].append(frames)
            parts["action"].append(action.astype(np.float32))
            parts["state"].append(np.concatenate([place, rng.normal(size=(length, dims - 2))], 1))
            parts["ep_idx"].append(np.full(length, number))
            parts["step_idx"].append(np.arange(length))
        rows = {name: np.concatenate(values) for name, values in parts.items()}
        rows["ep_len"] = np.array(lengths)
        return rows

    return make_rows


@pytest.fixture
def expected() -> Callable[..., list[dict[str, np.ndarray]]]:
    """``expected(rows)`` are the episodes that a conversion of those rows has to hold."""

    def expected(rows: dict[str, np.ndarray], state: str = "state") -> list[dict[str, np.ndarray]]:
        stops = np.cumsum(rows["ep_len"])
        episodes = []
        for start, stop in zip(stops - rows["ep_len"], stops):
            action = rows["action"][start:stop].copy()
            action[-1] = 0
            pixels = np.ascontiguousarray(rows["pixels"][start:stop].transpose(0, 3, 1, 2))
            episodes.append({"pixels": pixels, "action": action, "state": rows[state][start:stop].astype(np.float64)})
        return episodes

    return expected


@pytest.fixture(params=WRITERS)
def layout(request) -> str:
    """Each layout in turn."""
    return request.param


@pytest.fixture
def write() -> dict[str, Callable[[Path, dict[str, np.ndarray]], Path]]:
    """``write[layout](folder, rows)`` writes a file and returns its path."""
    return WRITERS
