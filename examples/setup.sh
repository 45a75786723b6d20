#!/bin/sh
# Set up refdgs-pipe in .venv of this checkout. With --dev: editable, and with the tools for tests.
# PYTHON chooses the interpreter (3.11 or newer), VENV another place.
set -eu
cd "$(dirname "$0")/.."
venv=${VENV:-.venv}
python=${PYTHON:-$(command -v python3.11 || command -v python3)}

# System libraries: open3d and pymeshlab want OpenGL and USB, the build wants a compiler and headers.
need=""
for pair in libGL.so.1=libgl1 libEGL.so.1=libegl1 libOpenGL.so.0=libopengl0 libX11.so.6=libx11-6 \
    libusb-1.0.so.0=libusb-1.0-0 libgomp.so.1=libgomp1; do
    ldconfig -p | grep -q "${pair%=*}" || need="$need ${pair#*=}"
done
command -v g++ >/dev/null || need="$need g++"
headers=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
[ -e "$headers/Python.h" ] || need="$need python3-dev"
"$python" -c 'import ensurepip, venv' 2>/dev/null || need="$need python3-venv"
if [ -n "$need" ]; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        apt-get update -qq && apt-get install -y -qq --no-install-recommends $need
    else
        echo "Install these first, then run this again: sudo apt-get install$need" >&2
        exit 1
    fi
fi

[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip="$venv/bin/python -m pip install --disable-pip-version-check -q -c constraints.txt"
if [ -e /proc/driver/nvidia/version ]; then
    $pip torch
else # without a GPU the build without CUDA is enough, and gigabytes smaller
    $pip --retries 1 --extra-index-url https://download.pytorch.org/whl/cpu --no-deps torch
fi
$pip scikit-build-core nanobind cmake ninja
if [ "${1:-}" = --dev ]; then
    $pip --no-build-isolation -e '.[dev]'
else
    $pip --no-build-isolation .
fi
echo "ready: $venv/bin/refdgs-pipe"
