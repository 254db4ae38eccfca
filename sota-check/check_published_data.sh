#!/usr/bin/env bash
# Files written by the published stable-worldmodel package, converted by ours, and compared number by number.
#
# Steps:
#   1. an environment of its own in $FOLDER/venv (unless SWM_PYTHON names a Python that has the package), with CPU
#      torch and what collecting needs; nothing of it is needed by this package;
#   2. published_data.py collect: a few TwoRoom and PushT episodes, kept as plain arrays and written by the package's
#      own HDF5 and Lance writers;
#   3. published_data.py compare: the four files through torchrl_ficreg.data.convert, against the plain arrays, and
#      the actions replayed in our environments.
#
# Usage: [FOLDER=/tmp/published_data] [PYTHON=.venv/bin/python] [SWM_PYTHON=...] sota-check/check_published_data.sh
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python}
folder=${FOLDER:-${TMPDIR:-/tmp}/published_data}
mkdir -p "$folder"
if [ -z "${SWM_PYTHON:-}" ]; then
  SWM_PYTHON="$folder/venv/bin/python"
  if [ ! -f "$folder/venv/.ready" ]; then
    python3 -m venv "$folder/venv"
    # torchvision is left out: it is needed for one type annotation, and published_data.py has a stand-in.
    "$SWM_PYTHON" -m pip install -q torch==2.13.0
    "$SWM_PYTHON" -m pip install -q --no-deps stable-worldmodel==0.1.1
    "$SWM_PYTHON" -m pip install -q gymnasium pymunk pygame shapely h5py hdf5plugin pylance lancedb pyarrow pillow \
      opencv-python-headless einops tqdm loguru tabulate typer rich imageio matplotlib scikit-learn hydra-core transformers
    touch "$folder/venv/.ready"
  fi
fi
export OMP_NUM_THREADS=1
"$SWM_PYTHON" sota-check/published_data.py collect "$folder"
"$python" sota-check/published_data.py compare "$folder"
