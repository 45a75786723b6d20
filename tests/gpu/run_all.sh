#!/bin/bash
# Build for this machine's GPU and prove it: the headline figure, parity, memory checks, a training. No network.
#
#   tests/gpu/run_all.sh [-w WHEELS] [-s SCENE] [-o OUT] [-d cuda|emulated]
#
# OUT [build/gpu-report] gets report.md and report.json, which are renewed after every step, and six logs; everything
# else goes to a folder of its own that is removed at the end. At most five minutes: a step that runs longer is ended,
# and the next one begins. What takes most of the time comes last.
#
# WHEELS: a folder of wheels of small packages that are missing or too old here (pydantic, pydantic-core,
# annotated-types, typing-inspection, typing-extensions; scipy, pillow, safetensors). If it holds a file
# _refdgs_native*.so or a wheel of refdgs-pipe that can be imported here, nothing is built.
# SCENE: a NeRF-synthetic folder; without one a procedural ball is trained.
# -d emulated: a dry run on the CPU and tiny: the build, parity of the emulated kernels, a training by the CPU's. It may
# take 20 minutes.
# Needs Python 3.11+ with its headers, torch, numpy, nanobind, pytest; cmake, nvcc 12.4+.
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
mkdir -p "$out" && out=$(cd "$out" && pwd) && rm -f "$out"/*.log "$out"/report.* || exit 73
work=$(mktemp -d) || exit 73
trap 'rm -rf "$work"' EXIT
limit=290 building=150
[ "$device" = emulated ] && limit=1200 building=600 # a dry run may take longer
total=${SECONDS_TOTAL:-$limit} most=${SECONDS_A_STEP:-1000}
started=$SECONDS

python=$(command -v "${PYTHON:-python3}") || exit 69
for folder in "${CUDA_HOME:-/usr/local/cuda}/bin" "$(dirname "$python")"; do
    [ -d "$folder" ] && PATH="$PATH:$folder"
done
export PATH PYTHONUNBUFFERED=1 root out work python device

left() { echo $((total - (SECONDS - started))); }

# step NAME LOG LIMIT COMMAND...: run it, keep its output in LOG, its exit code and seconds; go on whatever happens.
step() {
    local name=$1 log="$out/$2.log" limit=$3 begin=$SECONDS
    shift 3
    [ "$(left)" -lt "$limit" ] && limit=$(left)
    [ "$most" -lt "$limit" ] && limit=$most
    if [ "$limit" -lt 1 ]; then
        echo "$name: no time is left"
        return 1
    fi
    echo "== $name (at most $limit s)" | tee -a "$log"
    timeout -k 5 "$limit" "$@" >"$work/$name.said" 2>&1
    local code=$?
    [ "$code" = 137 ] && code=124
    cat "$work/$name.said" >>"$log"
    echo "$code $((SECONDS - begin))" >"$work/$name.status"
    tail -n 3 "$work/$name.said" | cut -c1-300
    "$python" "$root/tests/gpu/report.py" "$work" "$out" >/dev/null 2>>"$log"
    return $code
}

# What is missing here is unpacked; a native module that comes along is used if it can be.
if [ -n "$wheels" ]; then
    "$python" - "$wheels" "$work/site" "$work/built" <<'PYTHON'
import importlib.metadata, pathlib, shutil, sys, zipfile
wheels, site, built = map(pathlib.Path, sys.argv[1:])
built.mkdir()


def numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]


def has(name: str, version: str) -> bool:
    try:
        return numbers(importlib.metadata.version(name.replace("_", "-"))) >= numbers(version)
    except importlib.metadata.PackageNotFoundError:
        return False


for module in wheels.glob("_refdgs_native*.so"):
    shutil.copy(module, built)
for wheel in sorted(wheels.glob("*.whl")):
    name, version = wheel.name.split("-")[:2]
    with zipfile.ZipFile(wheel) as archive:
        if name == "refdgs_pipe":
            archive.extractall(built, [n for n in archive.namelist() if n.startswith("_refdgs_native")])
        elif not has(name, version):
            archive.extractall(site)
            print("unpacked", wheel.name)
PYTHON
    export PYTHONPATH="$work/site${PYTHONPATH:+:$PYTHONPATH}"
fi

emulator=OFF
[ "$device" = emulated ] && emulator=ON
build() {
    if [ "$device" = cuda ] && PYTHONPATH="$work/built${PYTHONPATH:+:$PYTHONPATH}" \
        "$python" -c 'import _refdgs_native as n; print("as it came, for", n.cuda_archs); exit(not n.cuda_archs)'; then
        return 0
    fi
    local arch=${REFDGS_CUDA_ARCHS:-} generator=()
    if [ -z "$arch" ] && [ "$device" = emulated ]; then arch=90-real; fi
    if [ -z "$arch" ]; then
        arch=$("$python" -c 'import torch; print("%d%d-real" % torch.cuda.get_device_capability())') || return 1
    fi
    command -v ninja >/dev/null && generator=(-G Ninja)
    cmake -S "$root/csrc" -B "$work/built" "${generator[@]}" -DCMAKE_BUILD_TYPE=Release -DREFDGS_CUDA=ON \
        -DREFDGS_CUDA_ARCHS="$arch" -DREFDGS_EMULATOR=$emulator -DPython_EXECUTABLE="$python" \
        -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" &&
        cmake --build "$work/built" -j "$(nproc)" &&
        PYTHONPATH="$work/built" "$python" -c 'import _refdgs_native as n; print("built for", n.cuda_archs)'
}
doctor() {
    "$python" - <<'PYTHON'
import json, os, sys
import torch
import _refdgs_native as native
from refdgs_pipe.cli.device import cuda_problem
problem = cuda_problem()
record = {"ok": problem is None, "problem": problem, "torch": torch.__version__, "torch CUDA": torch.version.cuda,
          "GPU": native.cuda_device(), "built for": native.cuda_archs, "python": sys.version.split()[0],
          "cores": os.cpu_count()}
json.dump(record, open(os.path.join(os.environ["work"], "doctor.json"), "w"))
print(record)
sys.exit(problem is not None and os.environ["device"] == "cuda")
PYTHON
}
# checker TOOL NAME SCRIPT...: one of compute-sanitizer's tools over our kernels.
checker() {
    local tool=$1 name=$2 only=()
    shift 2
    for option in --kernel-regex --kernel-name; do # by its version
        compute-sanitizer --help 2>&1 | grep -q -- $option && only=($option kns=refdgs)
    done
    compute-sanitizer --tool "$tool" "${only[@]}" --error-exitcode 9 "$python" "$@" --out "$work/$name-of.json"
}
# unwritten NAME SCRIPT...: what kernels other than torch's read before anything wrote it. It watches all kernels;
# otherwise it would report what torch's kernels wrote as unwritten. Torch gets memory from the driver each time: its pool
# hides much.
unwritten() {
    local name=$1 code
    shift
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool initcheck --print-limit 20000 \
        "$python" "$@" --out "$work/$name-of.json" >"$work/$name.reads" 2>&1
    code=$?
    grep -v '^=========' "$work/$name.reads"
    grep -A 1 Uninitialized "$work/$name.reads" | sed -n 's/^=* *at \([^<(]*\).*/read in \1/p' | sort | uniq -c
    if ! grep SUMMARY "$work/$name.reads"; then # the tool itself failed
        grep '^=========' "$work/$name.reads" | head -n 40
        return 9
    fi
    grep -A 1 Uninitialized "$work/$name.reads" | grep '^=* *at ' | grep -v 'at::\|at_cuda_detail\|c10::' && return 9
    return $code
}
export emulator
export -f build doctor checker unwritten

small=() tiny=() few=() short=()
if [ "$device" = emulated ]; then
    small=(--small)
    tiny=(--device cpu --side 48 --iterations 6 --surfels 500)
    short=(--volume-steps 20)
    few=(--device cpu --side 48 --surfels 300 --local 100 --steps 2 --warm 1)
fi
at="$root/tests/gpu"
step build build "$building" bash -c build
export PYTHONPATH="$work/built:$root${PYTHONPATH:+:$PYTHONPATH}"
step doctor build 40 bash -c doctor
step headline headline 60 "$python" "$at/headline.py" "${few[@]}" --out "$work/headline.json"
step parity parity 70 "$python" "$at/parity.py" --device "$device" "${small[@]}" --out "$work/parity.json"
step timing timing 40 "$python" "$at/timing.py" --device "$device" "${small[@]}" --out "$work/timing.json"
graph=auto # where recorded steps fail, which can take the GPU's context along, the training goes without
step graph timing 40 "$python" "$at/graph.py" "${tiny[@]}" --out "$work/graph.json" || graph=off
if [ "$device" = cuda ] && command -v compute-sanitizer >/dev/null; then
    for tool in memcheck racecheck synccheck; do
        step $tool checks 25 bash -c "checker $tool $tool '$at/parity.py' --small --once"
    done
    step initcheck checks 40 bash -c "unwritten initcheck '$at/parity.py' --small --once"
    step replay checks 30 bash -c "checker memcheck replay '$at/graph.py' --side 64 --iterations 12 --surfels 300"
fi
room=$(left)
step training training $((room > 15 ? room : 15)) "$python" "$at/training.py" ${scene:+--scene "$scene"} \
    --seconds $((room > 60 ? room - 40 : 20)) --graph $graph "${tiny[@]}" "${short[@]}" --out "$work/training.json"
"$python" "$at/report.py" "$work" "$out"
