"""Simulators that tests of environments need, and comparison of what these observe."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_ficreg.envs._gl import gl_works

NEEDED = {"push_t": "pymunk", "reacher": "dm_control", "cube": "ogbench"}


def require_simulator(name: str, *, pictures: bool = True) -> None:
    """Skips a test, or a whole file, where an environment cannot be simulated, or drawn."""
    if name in NEEDED:
        pytest.importorskip(NEEDED[name], reason=f"{name} needs {NEEDED[name]}: pip install 'torchrl_ficreg[envs]'")
    if pictures and name in ("reacher", "cube") and not gl_works():
        pytest.skip("no GL here: apt-get install libegl1 libgl1", allow_module_level=True)


def assert_same(ours, theirs) -> None:
    """Arrays or tensors under the same keys, equal to the last bit."""
    assert set(ours.keys()) == set(theirs.keys())
    for key in ours.keys():
        one, other = np.asarray(ours[key]), np.asarray(theirs[key])
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes(), key
