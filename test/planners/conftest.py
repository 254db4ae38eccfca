"""Planning in tests: one environment at a time."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def one_by_one(monkeypatch):
    """Groups of one environment, as with 257 candidates or more: equalities then hold to the last bit."""
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 1)
