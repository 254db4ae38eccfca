"""Planning in tests: one environment at a time."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def one_by_one(monkeypatch):
    """Few candidates share calls among environments; one by one, equalities hold to the last bit, as with 257 or more."""
    monkeypatch.setattr("torchrl_ficreg.planners.base.ROWS_AT_ONCE", 1)
