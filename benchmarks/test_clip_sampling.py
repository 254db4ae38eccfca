"""Claims about the time of a batch of 128 clips of 4 frames, measured in one run.

1.  At 64 and 224 px, ours takes at most a quarter of the time of TorchRL's SliceSampler with strided selection, and
    at most half of that of stock indexing of a TensorStorage, with one thread.
2.  With two threads ours is not slower than either.

`make slow` runs it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("clip_sampling.py")


@pytest.mark.slow
@pytest.mark.parametrize("size", [224, 64])
def test_clips_are_read_faster_than_by_the_plain_alternatives(tmp_path, size):
    only = ["--only", "TensorStorage", "SliceSampler", "--out", str(tmp_path / "out.json"), "--repeats", "20"]
    subprocess.run([sys.executable, str(SCRIPT), "--sizes", str(size), "--threads", "1", "2", *only], check=True)
    one, two = (result["ways"] for result in json.loads((tmp_path / "out.json").read_text())["results"])
    assert one["SliceSampler, 16 rows"]["times_ours"] >= 4
    assert one["TensorStorage, by index"]["times_ours"] >= 2
    assert min(row["times_ours"] for row in two.values()) >= 1
