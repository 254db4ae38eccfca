"""Claims about ``convert.py``: it converts, continues, and reports a user's mistake in one line."""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
from pathlib import Path

import pytest
from foreign_files import write_lewm, write_ogbench

from torchrl_ficreg.data import EpisodeStore

SCRIPT = Path(__file__).resolve().parents[3] / "sota-implementations" / "ficreg" / "convert.py"


@pytest.fixture
def execute(tmp_path):
    """``execute("source=x.h5")`` runs the script in an empty folder, in a fork, which has imported everything already."""

    def work(overrides):
        os.chdir(tmp_path)
        for descriptor, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(f".{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
            setattr(sys, name, open(descriptor, "w", buffering=1))
        sys.argv = [str(SCRIPT), *overrides]
        sys.path.insert(0, str(SCRIPT.parent))
        runpy.run_path(str(SCRIPT), run_name="__main__")

    def execute(*overrides, code=0):
        process = multiprocessing.get_context("fork").Process(target=work, args=(overrides,))
        process.start()
        process.join(120)
        assert process.exitcode == code, (tmp_path / ".stderr").read_text()
        return (tmp_path / ".stdout").read_text(), (tmp_path / ".stderr").read_text()

    return execute


def test_a_file_is_converted_and_continued(tmp_path, execute, make_rows):
    write_lewm(tmp_path / "two.h5", make_rows([30] * 6))
    settings = ["source=two.h5", "target=data/two", "env=two_room", "env.kwargs.collision=endpoint"]
    out, progress = execute(*settings, "limit=2")
    assert out.strip() == "data/two: 2 episodes, 60 steps" and "frame/s" in progress
    assert execute(*settings)[0].strip() == "data/two: 6 episodes, 180 steps"
    meta = EpisodeStore.open(tmp_path / "data" / "two").header.meta
    assert (meta["env"], meta["env_kwargs"]["collision"]) == ("two_room", "endpoint")


def test_converted_pictures_count_as_published(tmp_path, execute, make_rows):
    """Whatever our own recordings of the environment show by default."""
    rows = make_rows([30] * 6)
    write_lewm(tmp_path / "arm.h5", {**rows, "qpos": rows["state"], "qvel": 0 * rows["state"]})
    execute("source=arm.h5", "target=out", "env=reacher", "check_alignment=false")
    assert EpisodeStore.open(tmp_path / "out").header.meta["env_kwargs"]["detail"] == "published"


def test_other_data_name_their_columns(tmp_path, execute, make_rows):
    write_ogbench(tmp_path / "play.npz", make_rows([30] * 6, dims=4))
    execute("source=play.npz", "target=out", "env_name=mine", "state=[qpos]", "action_low=[-2,-2]", "action_high=[2,2]")
    store = EpisodeStore.open(tmp_path / "out")
    assert store.header.shapes["state"] == (2,) and store.header.meta["action_low"] == [-2, -2]


def test_a_mistake_ends_in_one_line_and_nothing_on_disk(tmp_path, execute, make_rows):
    write_lewm(tmp_path / "two.h5", make_rows([30] * 6))
    _, error = execute("source=two.h5", "target=out", "env=reacher", code=1)
    assert "has no number column for reacher's state" in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
