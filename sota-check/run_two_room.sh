#!/usr/bin/env bash
# FICReg and LeWM on TwoRoom, three seeds each, on the same data and frozen pairs.
# Writes docs/results/two_room.json. Finished runs are skipped; interrupted ones continue.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python}
for seed in ${SEEDS:-0 1 2}; do
  for method in ficreg lewm; do
    run="runs/two_room_cpu_${method}_seed${seed}"
    [ -f "$run/results.json" ] || "$python" sota-implementations/ficreg/train.py method="$method" seed="$seed"
  done
done
"$python" tools/study/summarize.py two_room 'runs/two_room_cpu_*_seed*/results.json'
