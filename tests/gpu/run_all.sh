#!/bin/bash
# Build for this machine's GPU and prove it: parity, determinism, memory checks, timings, a training. No network.
#
#   tests/gpu/run_all.sh [-w WHEELS] [-s SCENE] [-o OUT] [-d cuda|emulated]
#
# WHEELS: a folder of wheels of small packages that are missing here (pydantic, pydantic-core, annotated-types,
# typing-inspection; scipy, pillow, safetensors where they are missing too). SCENE: a NeRF-synthetic folder;
# without one a procedural ball is trained. OUT: gets report.md, report.json and the logs [build/gpu-report].
# -d emulated: a dry run of the steps that need no GPU, on the CPU and tiny.
# Needs Python 3.11+ with torch, numpy, nanobind, pytest; cmake, ninja, nvcc 12.4+. At most 9 minutes.
set -u
root=$(cd "$(dirname "$0")/../.." && pwd)
wheels="" scene="" out="$root/build/gpu-report" device=cuda
while getopts "w:s:o:d:" flag; do
    case $flag in
    w) wheels=$(cd "$OPTARG" && pwd) || exit 64 ;;
    s) scene=$(cd "$OPTARG" && pwd) || exit 64 ;;
    o) out=$OPTARG ;;
    d) device=$OPTARG ;;
    *) exit 64 ;;
    esac
done
mkdir -p "$out" && out=$(cd "$out" && pwd) && rm -f "$out"/*.status "$out"/*.json "$out"/*.log || exit 73
python=${PYTHON:-python3}
total=${SECONDS_TOTAL:-525} # of nine minutes, some are left for the report
started=$SECONDS

left() { echo $((total - (SECONDS - started))); }

# step NAME LIMIT COMMAND...: run it, keep its log, exit code and seconds; go on whatever happens.
step() {
    local name=$1 limit=$2 begin=$SECONDS
    shift 2
    [ "$(left)" -lt "$limit" ] && limit=$(left)
    if [ "$limit" -lt 5 ]; then
        echo "$name: no time is left"
        return 1
    fi
    echo "== $name (at most $limit s)"
    timeout -k 10 "$limit" "$@" >"$out/$name.log" 2>&1
    local code=$?
    echo "$code $((SECONDS - begin))" >"$out/$name.status"
    tail -n 3 "$out/$name.log"
    return $code
}

if [ -n "$wheels" ]; then
    site="$out/site"
    "$python" - "$wheels" <<'PYTHON' >"$out/wheels.txt"
import importlib.util, pathlib, sys
names = {"pydantic_core": "pydantic_core", "annotated_types": "annotated_types", "pillow": "PIL"}
for wheel in sorted(pathlib.Path(sys.argv[1]).glob("*.whl")):
    name = wheel.name.split("-")[0].lower()
    if importlib.util.find_spec(names.get(name, name)) is None:
        print(wheel)
PYTHON
    if [ -s "$out/wheels.txt" ]; then
        xargs -n 1 "$python" -m pip install -q --no-index --no-deps --no-compile --upgrade --target "$site" <"$out/wheels.txt"
        export PYTHONPATH="$site${PYTHONPATH:+:$PYTHONPATH}"
    fi
fi

build() {
    local arch=${REFDGS_CUDA_ARCHS:-}
    if [ -z "$arch" ]; then
        arch=$("$python" -c 'import torch; print("%d%d-real" % torch.cuda.get_device_capability())') || return 1
    fi
    cmake -S "$root/csrc" -B "$out/cmake" -G Ninja -DCMAKE_BUILD_TYPE=Release -DREFDGS_CUDA=ON \
        -DREFDGS_CUDA_ARCHS="$arch" -DREFDGS_EMULATOR=OFF \
        -DPython_EXECUTABLE="$("$python" -c 'import sys; print(sys.executable)')" \
        -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" &&
        cmake --build "$out/cmake" -j "$(nproc)"
}
export -f build
export root out python
# what was built comes before anything that is installed
modules="$out/cmake"

doctor() {
    "$python" - <<'PYTHON'
import json, os, sys
import torch
import _refdgs_native as native
from refdgs_pipe.cli.device import cuda_problem
problem = cuda_problem()
record = {"ok": problem is None, "problem": problem, "torch": torch.__version__, "torch CUDA": torch.version.cuda,
          "GPU": native.cuda_device(), "built for": native.cuda_archs, "module": native.__file__}
json.dump(record, open(os.path.join(os.environ["out"], "doctor.json"), "w"))
print(record)
sys.exit(problem is not None)
PYTHON
}
export -f doctor

checker() {
    local only=()
    compute-sanitizer --help 2>&1 | grep -q -- --kernel-regex && only=(--kernel-regex kns=refdgs)
    compute-sanitizer --tool "$1" "${only[@]}" --error-exitcode 9 \
        "$python" "$root/tests/gpu/parity.py" --small --out "$out/$1-parity.json"
}
export -f checker

small=()
[ "$device" = emulated ] && small=(--small)
if [ "$device" = cuda ]; then
    step build 200 bash -c build
    export PYTHONPATH="$modules:$root${PYTHONPATH:+:$PYTHONPATH}"
    step doctor 60 bash -c doctor
else
    export PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}"
fi
step parity 150 "$python" "$root/tests/gpu/parity.py" --device "$device" "${small[@]}" --out "$out/parity.json"
step timing 90 "$python" "$root/tests/gpu/timing.py" --device "$device" "${small[@]}" --out "$out/timing.json"
tiny=()
[ "$device" = emulated ] && tiny=(--device cpu --side 48 --iterations 6 --surfels 500)
# the checkers come last and have a minute each; the training has what is left of the rest
room=$(($(left) - 130))
step training $((room > 30 ? room : 30)) "$python" "$root/tests/gpu/training.py" ${scene:+--scene "$scene"} \
    --seconds $((room > 70 ? room - 60 : 20)) "${tiny[@]}" --out "$out/training.json"
if [ "$device" = cuda ]; then
    if command -v compute-sanitizer >/dev/null; then
        step memcheck 65 bash -c 'checker memcheck'
        step racecheck 60 bash -c 'checker racecheck'
    fi
fi
"$python" "$root/tests/gpu/report.py" "$out"
