"""Claims about files whose rows are not alike.

1.  Lists that differ in length are refused, also where they add up to the right number of values.
2.  Episodes whose frames have other sizes are refused, not scaled behind the user's back.
3.  Numbers too large to be squared do not pass for aligned ones.
4.  An archive damaged in what is read first is refused with its name.
"""

from __future__ import annotations

import numpy as np
import pytest
from foreign_files import write_ogbench

from torchrl_ficreg.data.convert import from_arrays, measure_alignment, open_source
from torchrl_ficreg.data.convert._arrow import to_array
from torchrl_ficreg.data.convert.table import Column, require


def test_lists_of_other_lengths_are_refused():
    arrow = require("pyarrow", "pylance")
    kind = arrow.list_(arrow.float64())
    column = Column((2,), "number", 2)
    even = arrow.chunked_array([[[1.0, 2.0], [3.0, 4.0]]], kind)
    np.testing.assert_array_equal(to_array(even, column), [[1, 2], [3, 4]])
    with pytest.raises(ValueError, match=r"lists of 2 values were expected, got lengths \[1, 3\]"):
        to_array(arrow.chunked_array([[[1.0], [2.0, 3.0, 4.0]]], kind), column)


def test_frames_of_another_size_are_refused(make_rows, monkeypatch):
    rows = make_rows(lengths=[20, 20])
    columns = {key: rows[key] for key in ("pixels", "action", "state")}
    source = from_arrays(**columns, lengths=[20, 20])
    read = source.table.read

    def halved(name, start, stop):
        return read(name, start, stop)[:, ::2, ::2] if name == "pixels" else read(name, start, stop)

    monkeypatch.setattr(source.table, "read", halved)
    with pytest.raises(ValueError, match="frames must have one size"):
        source.episode(1)


def test_overflowing_states_are_not_called_aligned():
    action = np.random.default_rng(0).normal(size=(200, 2))
    state = np.concatenate([np.zeros((1, 2)), action.cumsum(0)[:-1]])
    with np.errstate(over="ignore", invalid="ignore"):
        assert measure_alignment([(np.roll(action, 1, 0), 1e200 * state)]).lag is None


def test_an_archive_with_a_damaged_small_array_is_refused_by_name(tmp_path, make_rows):
    path = write_ogbench(tmp_path / "play.npz", make_rows(dims=4))
    content = bytearray(path.read_bytes())
    place = content.find(b"terminals.npy") + 40
    content[place] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path.name} cannot be read .*damaged"):
        open_source(path)
