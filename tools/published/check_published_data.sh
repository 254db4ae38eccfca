#!/usr/bin/env bash
# Converts files written by the published stable-worldmodel package and compares them with the recorded arrays.
#
# Steps:
#   1. a virtual environment in $FOLDER/venv (unless SWM_PYTHON names a Python that has the package), with CPU torch and
#      the packages that collecting needs; this package needs none of them;
#   2. published_data.py collect: a few TwoRoom and PushT episodes, saved as plain arrays and by the package's HDF5 and
#      Lance writers;
#   3. published_data.py compare: converts the four files, compares them with the plain arrays, and replays the actions
#      in our environments.
#
# Usage: [FOLDER=/tmp/published_data] [PYTHON=.venv/bin/python] [SWM_PYTHON=...] tools/published/check_published_data.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
python=${PYTHON:-python}
folder=${FOLDER:-${TMPDIR:-/tmp}/published_data}
mkdir -p "$folder"
if [ -z "${SWM_PYTHON:-}" ]; then
  SWM_PYTHON="$folder/venv/bin/python"
  if [ ! -f "$folder/venv/.ready" ]; then
    python3 -m venv "$folder/venv"
    # Without torchvision, which is needed for one type annotation only: published_data.py replaces it.
    "$SWM_PYTHON" -m pip install -q torch==2.13.0
    "$SWM_PYTHON" -m pip install -q --no-deps stable-worldmodel==0.1.1
    "$SWM_PYTHON" -m pip install -q gymnasium pymunk pygame shapely h5py hdf5plugin pylance lancedb pyarrow pillow \
      opencv-python-headless einops tqdm loguru tabulate typer rich imageio matplotlib scikit-learn hydra-core transformers
    touch "$folder/venv/.ready"
  fi
fi
export OMP_NUM_THREADS=1
"$SWM_PYTHON" tools/published/published_data.py collect "$folder"
"$python" tools/published/published_data.py compare "$folder"
