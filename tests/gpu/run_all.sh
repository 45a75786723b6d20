#!/bin/bash
# Build for this machine's GPU and prove it: parity, determinism, memory checks, timings, a training. No network.
#
#   tests/gpu/run_all.sh [-w WHEELS] [-s SCENE] [-o OUT] [-d cuda|emulated]
#
# WHEELS: a folder of wheels of small packages that are missing here (pydantic, pydantic-core, annotated-types,
# typing-inspection; scipy, pillow, safetensors where they are missing too). A wheel of refdgs-pipe itself in it is used
# where the build fails. SCENE: a NeRF-synthetic folder; without one a procedural ball is trained. OUT: gets report.md,
# report.json and the logs [build/gpu-report]; the report is renewed after every step.
# -d emulated: a dry run on the CPU and tiny: the build, parity of the emulated kernels, a training by the CPU's.
# Needs Python 3.11+ with its headers, torch, numpy, nanobind, pytest; cmake, nvcc 12.4+. At most 9 minutes.
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
total=${SECONDS_TOTAL:-525} # of nine minutes, some are left for the report
started=$SECONDS

python=$("${PYTHON:-python3}" -c 'import sys; print(sys.executable)') || exit 69
for folder in "${CUDA_HOME:-/usr/local/cuda}/bin" "$(dirname "$python")"; do
    [ -d "$folder" ] && PATH="$folder:$PATH"
done
export PATH PYTHONUNBUFFERED=1

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
    [ "$code" = 137 ] && code=124
    echo "$code $((SECONDS - begin))" >"$out/$name.status"
    tail -n 3 "$out/$name.log"
    "$python" "$root/tests/gpu/report.py" "$out" >"$out/report.log" 2>&1
    return $code
}

# What is missing here is unpacked beside the report; the native module goes to a place of its own.
if [ -n "$wheels" ]; then
    "$python" - "$wheels" "$out/site" "$out/prebuilt" <<'PYTHON' 2>&1 | tee "$out/wheels.log"
import importlib.util, pathlib, sys, zipfile
wheels, site, prebuilt = map(pathlib.Path, sys.argv[1:])
modules = {"pillow": "PIL", "opencv_python_headless": "cv2"}
for wheel in sorted(wheels.glob("*.whl")):
    name = wheel.name.split("-")[0].lower()
    with zipfile.ZipFile(wheel) as archive:
        if name == "refdgs_pipe":
            archive.extractall(prebuilt, [n for n in archive.namelist() if n.startswith("_refdgs_native")])
        elif importlib.util.find_spec(modules.get(name, name)) is None:
            archive.extractall(site)
            print("unpacked", wheel.name)
PYTHON
    export PYTHONPATH="$out/site${PYTHONPATH:+:$PYTHONPATH}"
fi

emulator=OFF
[ "$device" = emulated ] && emulator=ON
build() {
    local arch=${REFDGS_CUDA_ARCHS:-} generator=()
    if [ -z "$arch" ] && [ "$device" = emulated ]; then arch=90-real; fi
    if [ -z "$arch" ]; then
        arch=$("$python" -c 'import torch; print("%d%d-real" % torch.cuda.get_device_capability())') || return 1
    fi
    command -v ninja >/dev/null && generator=(-G Ninja)
    "$python" -c 'import os, sysconfig; h = os.path.join(sysconfig.get_path("include"), "Python.h"); print(h, os.path.exists(h))'
    cmake -S "$root/csrc" -B "$out/cmake" "${generator[@]}" -DCMAKE_BUILD_TYPE=Release -DREFDGS_CUDA=ON \
        -DREFDGS_CUDA_ARCHS="$arch" -DREFDGS_EMULATOR=$emulator -DPython_EXECUTABLE="$python" \
        -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" &&
        cmake --build "$out/cmake" -j "$(nproc)" &&
        PYTHONPATH="$out/cmake" "$python" -c 'import _refdgs_native as n; print("built for", n.cuda_archs)'
}
export -f build
export root out python device emulator

doctor() {
    "$python" - <<'PYTHON'
import json, os, sys
import torch
import _refdgs_native as native
from refdgs_pipe.cli.device import cuda_problem
problem = cuda_problem()
record = {"ok": problem is None, "problem": problem, "torch": torch.__version__, "torch CUDA": torch.version.cuda,
          "GPU": native.cuda_device(), "built for": native.cuda_archs, "module": native.__file__,
          "python": sys.version.split()[0], "cores": os.cpu_count()}
json.dump(record, open(os.path.join(os.environ["out"], "doctor.json"), "w"))
print(record)
sys.exit(problem is not None and os.environ["device"] == "cuda")
PYTHON
}
export -f doctor

checker() {
    local only=()
    compute-sanitizer --help 2>&1 | grep -q -- --kernel-regex && only=(--kernel-regex kns=refdgs)
    compute-sanitizer --tool "$1" "${only[@]}" --error-exitcode 9 \
        "$python" "$root/tests/gpu/parity.py" --small --once --out "$out/$1-parity.json"
}
export -f checker

small=() tiny=()
if [ "$device" = emulated ]; then
    small=(--small)
    tiny=(--device cpu --side 48 --iterations 6 --surfels 500)
fi
step build "${BUILD_SECONDS:-200}" bash -c build
# what was built comes before anything that is installed, and the wheel's module after it
built="$out/cmake"
[ "$(cut -d' ' -f1 "$out/build.status")" = 0 ] || built="$out/prebuilt"
export PYTHONPATH="$built:$root${PYTHONPATH:+:$PYTHONPATH}"
step doctor 120 bash -c doctor
step parity 150 "$python" "$root/tests/gpu/parity.py" --device "$device" "${small[@]}" --out "$out/parity.json"
step timing 90 "$python" "$root/tests/gpu/timing.py" --device "$device" "${small[@]}" --out "$out/timing.json"
graph=auto # where recorded steps fail, which can take the GPU's context along, the training goes without
step graph 75 "$python" "$root/tests/gpu/graph.py" "${tiny[@]}" --out "$out/graph.json" || graph=off
# the checkers come last and have a minute each; the training has what is left of the rest
room=$(($(left) - 130))
step training $((room > 30 ? room : 30)) "$python" "$root/tests/gpu/training.py" ${scene:+--scene "$scene"} \
    --seconds $((room > 90 ? room - 80 : 20)) --graph $graph "${tiny[@]}" --out "$out/training.json"
if [ "$device" = cuda ] && command -v compute-sanitizer >/dev/null; then
    step memcheck 65 bash -c 'checker memcheck'
    step racecheck 60 bash -c 'checker racecheck'
fi
"$python" "$root/tests/gpu/report.py" "$out"
