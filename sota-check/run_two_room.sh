#!/usr/bin/env bash
# FICReg against LeWM on TwoRoom, same data, same frozen pairs: three seeds each.
# Writes docs/results/two_room.json. Finished runs are not repeated; an interrupted one continues.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python}
for seed in ${SEEDS:-0 1 2}; do
  for method in ficreg lewm; do
    run="runs/two_room_cpu_${method}_seed${seed}"
    [ -f "$run/results.json" ] || "$python" sota-implementations/ficreg/train.py method="$method" seed="$seed"
  done
done
"$python" sota-check/summarize.py two_room 'runs/two_room_cpu_*_seed*/results.json'
