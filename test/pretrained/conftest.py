"""A small published checkpoint, and limits of memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from checkpoints import write
from golden.formula import weights

from torchrl_ficreg.pretrained import load_lewm


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """The published checkpoint of the case ``"tiny"``, as a world model; not to be changed."""
    return load_lewm(write(tmp_path_factory.mktemp("tiny"), weights("tiny")))


@pytest.fixture
def at_most():
    """Limits the address space that this process may still take to a gigabyte."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
