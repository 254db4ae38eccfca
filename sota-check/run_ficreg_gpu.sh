#!/usr/bin/env bash
# LeWM and FICReg on TwoRoom and PushT on one CUDA machine that has torch and needs no network.
#
#   sota-check/run_ficreg_gpu.sh                  a slot of ten minutes; the same command continues in the next slot
#   sota-check/run_ficreg_gpu.sh --minutes 60     another length
#   sota-check/run_ficreg_gpu.sh --dry-run        everything in tiny sizes, on the CPU
#
# Episodes are recorded on all cores; both methods share them, and the frozen start-goal pairs drawn from them. Then
# four runs with model=gpu_short, each trained and evaluated by train.py, and a profile of a training step.
#
#   --out DIR     report: ficreg_gpu.json, pictures, log.txt, few and small; default $OUT, else <work>/report
#   --work DIR    episodes and runs, which the next slot needs (10 GB); default runs/gpu_short
#   --wheels DIR  wheels of what is missing beside torch; default sota-check/wheels
#
# Exit code 0: all is done. 75: time was up, give the same command again. Anything else: an error, in log.txt.
#
# To fill a folder of wheels on a machine with a network, for Python 3.12 on the other (antlr4 comes as source only):
#   pip download --no-deps --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 \
#     --platform manylinux_2_17_x86_64 --platform manylinux1_x86_64 -d wheels torchrl==0.14.1 tensordict==0.14.3 \
#     hoptorch pyvers orjson importlib-metadata gymnasium farama-notifications hydra-core==1.3.8 omegaconf pymunk
#   pip wheel --no-deps -w wheels antlr4-python3-runtime==4.9.3
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
out=${OUT:-} work= wheels= kind=gpu_short options=()
while [ $# -gt 0 ]; do
  case $1 in
    --out) out=$2; shift 2 ;;
    --work) work=$2; shift 2 ;;
    --wheels) wheels=$2; shift 2 ;;
    --minutes) options+=(--minutes "$2"); shift 2 ;;
    --dry-run) kind=gpu_dry_run options+=(--dry-run); export OMP_NUM_THREADS=1; shift ;;
    --help) sed -n '2,/^set/p' "$0" | sed '$d; s/^# \{0,1\}//'; exit ;;
    *) echo "error: unknown option $1; see --help." >&2; exit 2 ;;
  esac
done
work=${work:-$root/runs/$kind}
mkdir -p "$work" "${out:=$work/report}"
work=$(cd "$work" && pwd) out=$(cd "$out" && pwd)

export PYTHONPATH=$root:$work/site${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
"$python" -c 'import torch' 2> /dev/null || { echo "error: $python has no torch; name another by PYTHON=..." >&2; exit 2; }

# Module and package of each thing needed beside torch. Not a venv: made from one, it would not see that one's torch.
needed='torchrl:torchrl tensordict:tensordict hoptorch:hoptorch pyvers:pyvers cloudpickle:cloudpickle orjson:orjson
  importlib_metadata:importlib-metadata zipp:zipp gymnasium:gymnasium farama_notifications:farama-notifications
  typing_extensions:typing-extensions packaging:packaging numpy:numpy tqdm:tqdm hydra:hydra-core omegaconf:omegaconf
  antlr4:antlr4-python3-runtime yaml:pyyaml pymunk:pymunk cffi:cffi pycparser:pycparser matplotlib:matplotlib
  imageio:imageio PIL:pillow'
missing=$("$python" - $needed <<'PYTHON'
import importlib.util, sys
pairs = (name.split(":") for name in sys.argv[1:])
print(*(package for module, package in pairs if importlib.util.find_spec(module) is None))
PYTHON
)
if [ -n "$missing" ]; then
  wheels=${wheels:-$root/sota-check/wheels}
  echo "from $wheels: $missing"
  # shellcheck disable=SC2086
  "$python" -m pip install --quiet --no-index --no-deps --find-links "$wheels" --target "$work/site" $missing ||
    { echo "error: put wheels of these into $wheels, or name their folder by --wheels; see --help." >&2; exit 2; }
fi
exec "$python" "$root/sota-check/ficreg_gpu.py" --work "$work" --out "$out" ${options[@]+"${options[@]}"}
