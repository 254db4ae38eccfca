#!/usr/bin/env bash
# LeWM and FICReg on TwoRoom and PushT, on one CUDA machine with torch and without network.
#
#   sota-check/run_ficreg_gpu.sh                  a slot of ten minutes; the same command continues in the next slot
#   sota-check/run_ficreg_gpu.sh --minutes 60     another length
#   sota-check/run_ficreg_gpu.sh --dry-run        everything in tiny sizes, on the CPU
#
# Records episodes on all cores, for both methods, and draws frozen start-goal pairs. Then trains and evaluates four runs
# with model=gpu_short (train.py), and profiles a training step.
#
#   --out DIR     report: ficreg_gpu.json, pictures, log.txt; default $OUT, else <work>/report. Updated every minute;
#                 pictures are drawn at the end, if matplotlib is available
#   --work DIR    episodes and runs, which the next slot needs (10 GB); default runs/gpu_short
#   --wheels DIR  wheels of missing packages; default sota-check/wheels
#   --fetch       only fill that folder (50 MB, for Linux on x86_64 with Python 3.12), on a machine with a network
#
# Exit code 0: finished. 75: the slot ended, run the same command again. Otherwise: an error, in log.txt.
set -euo pipefail
began=$(date +%s)
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
out=${OUT:-} work= wheels=$root/sota-check/wheels fetch= kind=gpu_short options=(--began "$began")
while [ $# -gt 0 ]; do
  case $1 in
    --out) out=$2; shift 2 ;;
    --work) work=$2; shift 2 ;;
    --wheels) wheels=$2; shift 2 ;;
    --fetch) fetch=yes; shift ;;
    --minutes) options+=(--minutes "$2"); shift 2 ;;
    --dry-run) kind=gpu_dry_run options+=(--dry-run); export OMP_NUM_THREADS=1; shift ;;
    --help) sed -n '2,/^set/p' "$0" | sed '$d; s/^# \{0,1\}//'; exit ;;
    *) echo "error: unknown option $1; see --help." >&2; exit 2 ;;
  esac
done

# Module, package and version of all required packages but torch, with their dependencies; then those of pictures.
needed='torchrl:torchrl==0.14.1 tensordict:tensordict==0.14.3 hoptorch:hoptorch==0.1.4 pyvers:pyvers==0.2.3
  cloudpickle:cloudpickle==3.1.2 orjson:orjson==3.13.0 importlib_metadata:importlib-metadata==10.2.0
  lazy_importer:lazy-importer==0.1.0 zipp:zipp==4.1.2 packaging:packaging==26.3 numpy:numpy==2.4.6 tqdm:tqdm==4.70.1
  gymnasium:gymnasium==1.4.0 farama_notifications:farama-notifications==0.0.6
  typing_extensions:typing-extensions==4.16.0 hydra:hydra-core==1.3.8 omegaconf:omegaconf==2.3.1
  antlr4:antlr4-python3-runtime==4.9.3 yaml:pyyaml==6.0.3 pymunk:pymunk==7.3.1
  cffi:cffi==2.1.1 pycparser:pycparser==3.12'
pictures='matplotlib:matplotlib==3.11.2 contourpy:contourpy==1.3.3 cycler:cycler==0.12.1 fontTools:fonttools==4.68.0
  kiwisolver:kiwisolver==1.5.1 pyparsing:pyparsing==3.3.3 dateutil:python-dateutil==4.0.0
  tzdata:tzdata==2026.6 imageio:imageio==2.38.1 PIL:pillow==13.0.0'

if [ -n "$fetch" ]; then
  binary=() source=()
  for name in $needed $pictures; do  # antlr4 comes as source only
    case $name in antlr4:*) source+=("${name#*:}") ;; *) binary+=("${name#*:}") ;; esac
  done
  "$python" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 --dest "$wheels" \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 --platform manylinux_2_17_x86_64 \
    --platform manylinux2014_x86_64 --platform manylinux1_x86_64 "${binary[@]}"
  "$python" -m pip wheel --quiet --no-deps --wheel-dir "$wheels" "${source[@]}"
  echo "$(ls "$wheels" | wc -l) wheels in $wheels"
  exit
fi

work=${work:-$root/runs/$kind}
mkdir -p "$work" "${out:=$work/report}"
work=$(cd "$work" && pwd) out=$(cd "$out" && pwd)

export PYTHONPATH=$root:$root/benchmarks:$work/site${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
"$python" -c 'import torch' 2> /dev/null ||
  { echo "error: $python has no torch; name another by PYTHON=..." >&2; exit 2; }

# No venv: created from another venv, it would not contain that one's torch. Installed packages of other versions are accepted.
missing() {
  "$python" - "$@" <<'PYTHON'
import importlib.util, re, sys
names = (re.split(":|==", name) for name in sys.argv[1:])
print(*(package for module, package, _ in names if importlib.util.find_spec(module) is None))
PYTHON
}
add() {
  echo "from $wheels: $*"
  "$python" -m pip install --quiet --no-index --no-deps --find-links "$wheels" --target "$work/site" "$@"
}
lack=$(missing $needed)
if [ -n "$lack" ]; then  # shellcheck disable=SC2086
  add $lack ||
    { echo "error: fill $wheels by --fetch elsewhere, or name a folder by --wheels; see --help." >&2; exit 2; }
fi
lack=$(missing $pictures)
if [ -n "$lack" ]; then  # shellcheck disable=SC2086
  add $lack 2> /dev/null || true  # the slot says at its end that pictures are skipped
fi
exec "$python" "$root/tools/gpu/ficreg_gpu.py" --work "$work" --out "$out" ${options[@]+"${options[@]}"}
