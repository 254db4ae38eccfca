"""Converters from other dataset formats: HDF5, Lance, LeRobot, OGBench and arrays in memory."""

from __future__ import annotations

from torchrl_ficreg.data.convert.alignment import Alignment, measure_alignment
from torchrl_ficreg.data.convert.arrays import from_arrays
from torchrl_ficreg.data.convert.conversion import convert, verify_alignment
from torchrl_ficreg.data.convert.formats import detect_format, FORMATS, open_source
from torchrl_ficreg.data.convert.source import EpisodeSource, TASKS

__all__ = [
    "Alignment",
    "EpisodeSource",
    "FORMATS",
    "TASKS",
    "convert",
    "detect_format",
    "from_arrays",
    "measure_alignment",
    "open_source",
    "verify_alignment",
]
