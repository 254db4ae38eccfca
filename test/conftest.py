"""Fixtures of all tests."""

from __future__ import annotations

import pytest


@pytest.fixture(params=[True, False], ids=["fast_bf16", "slow_bf16"])
def fast_bf16(request, monkeypatch) -> bool:
    """Whether this processor is taken for one with fast bfloat16 products: a test runs once for each."""
    monkeypatch.setattr("torchrl_ficreg.modules.precision.has_fast_bf16", lambda device, kind="products": request.param)
    return request.param
