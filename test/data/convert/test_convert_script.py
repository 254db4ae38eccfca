"""Claims about ``convert.py``: it converts, continues, and ends a user's mistake in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from foreign_files import write_lewm, write_ogbench

from torchrl_ficreg.data import EpisodeStore

SCRIPT = Path(__file__).resolve().parents[3] / "sota-implementations" / "ficreg" / "convert.py"


@pytest.fixture
def execute(tmp_path):
    """``execute("source=x.h5")`` runs the script in an empty folder."""

    def run(*overrides):
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        line = [sys.executable, str(SCRIPT), *overrides]
        return subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)

    return run


def test_a_file_is_converted_and_continued(tmp_path, execute, make_rows):
    write_lewm(tmp_path / "two.h5", make_rows([30] * 6))
    done = execute("source=two.h5", "target=data/two", "env=two_room", "limit=2", "env.kwargs.collision=endpoint")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "data/two: 2 episodes, 60 steps"
    assert "frame/s" in done.stderr
    done = execute("source=two.h5", "target=data/two", "env=two_room", "env.kwargs.collision=endpoint")
    assert done.stdout.strip() == "data/two: 6 episodes, 180 steps"
    meta = EpisodeStore.open(tmp_path / "data" / "two").header.meta
    assert (meta["env"], meta["env_kwargs"]["collision"]) == ("two_room", "endpoint")


def test_other_data_name_their_columns(tmp_path, execute, make_rows):
    write_ogbench(tmp_path / "play.npz", make_rows([30] * 6, dims=4))
    done = execute(
        "source=play.npz", "target=out", "env_name=mine", "state=[qpos]", "action_low=[-2,-2]", "action_high=[2,2]"
    )
    assert done.returncode == 0, done.stderr
    store = EpisodeStore.open(tmp_path / "out")
    assert store.header.shapes["state"] == (2,) and store.header.meta["action_low"] == [-2, -2]


def test_a_mistake_ends_in_one_line_and_nothing_on_disk(tmp_path, execute, make_rows):
    write_lewm(tmp_path / "two.h5", make_rows([30] * 6))
    done = execute("source=two.h5", "target=out", "env=reacher")
    assert done.returncode == 1 and "has no number column for reacher's state" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
