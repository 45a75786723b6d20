"""The checks for a GPU machine run here as far as they can: dry, and without what is not there."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import glossy_pair, orbit

ROOT = Path(__file__).parent.parent.parent
CHECKS = ROOT / "tests" / "gpu"
ABSENT = ("open3d", "pycolmap", "pymeshlab", "rawpy", "xatlas", "pxr", "cv2", "exifread")
REFUSE = f"""
import sys


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {ABSENT!r}:
            raise ModuleNotFoundError(f"{{name}} is not on a GPU machine", name=name)


sys.meta_path.insert(0, Refuse())
"""


def run(script: str, *arguments: str, paths: tuple[Path, ...] = ()) -> None:
    known = [path for path in sys.path if path]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*(str(path) for path in paths), str(ROOT), *known]),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, str(CHECKS / script), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def synthetic_folder(folder: Path) -> None:
    """A scene as NeRF-synthetic has them."""
    scene, size = glossy_pair(), 32
    for split, cameras in (
        ("train", orbit(6, size=size, focal=45.0)),
        ("test", orbit(2, size=size, focal=45.0)),
    ):
        (folder / split).mkdir(parents=True)
        frames = []
        for i, camera in enumerate(cameras):
            maps = scene.surface_map(camera)
            rgba = np.concatenate([maps.color, maps.alpha[..., None]], -1)
            name = f"{split}/r_{i}"
            Image.fromarray(np.round(rgba * 255).astype(np.uint8)).save(folder / f"{name}.png")
            pose = camera.world_from_cam.copy()
            pose[:3, 1:3] *= -1
            frames.append({"file_path": f"./{name}", "transform_matrix": pose.tolist()})
        angle = 2 * np.arctan(size / 2 / 45.0)
        record = {"camera_angle_x": float(angle), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(record))


def test_a_training_needs_none_of_the_libraries_that_a_gpu_machine_lacks(tmp_path: Path) -> None:
    (tmp_path / "refuse").mkdir()
    (tmp_path / "refuse" / "sitecustomize.py").write_text(REFUSE)
    synthetic_folder(tmp_path / "scene")
    out = tmp_path / "training.json"
    where = ["--scene", str(tmp_path / "scene"), "--device", "cpu", "--out", str(out)]
    few = ["--iterations", "4", "--surfels", "200", "--side", "32", "--volume-steps", "10"]
    run("training.py", *where, *few, paths=(tmp_path / "refuse",))
    record = json.loads(out.read_text())
    assert record["steps"] == 4 and record["views"] == [6, 2]
    assert record["same bits in two runs"] and record["test PSNR"] > 5


def test_the_comparison_with_recorded_steps_runs_dry(tmp_path: Path) -> None:
    out = tmp_path / "graph.json"
    few = ["--iterations", "3", "--surfels", "200", "--side", "32"]
    run("graph.py", "--device", "cpu", *few, "--out", str(out))
    record = json.loads(out.read_text())
    assert record["ok"] and record["same bits"] and record["steps"] == 3


@pytest.mark.slow
def test_the_headline_runs_dry(tmp_path: Path) -> None:
    out = tmp_path / "headline.json"
    few = ["--side", "48", "--surfels", "300", "--local", "100", "--steps", "2", "--warm", "1"]
    run("headline.py", "--device", "cpu", *few, "--out", str(out))
    record = json.loads(out.read_text())
    assert record["ok"] and record["surfels"] == [300, 100] and record["of"] == 2


@pytest.mark.slow
def test_parity_and_timing_run_dry(tmp_path: Path) -> None:
    pytest.importorskip("_refdgs_emulated")
    for name in ("parity", "timing"):
        run(
            f"{name}.py", "--device", "emulated", "--small", "--out", str(tmp_path / f"{name}.json")
        )
        (tmp_path / f"{name}.status").write_text("0 1")
    record = json.loads((tmp_path / "parity.json").read_text())
    assert record["ok"] and len(record["rows"]) > 150
    done = subprocess.run(
        [sys.executable, str(CHECKS / "report.py"), str(tmp_path), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (
        done.returncode == 1 and "NOT ok: build, doctor, headline, graph, training" in done.stdout
    )
    assert "| edge-on | 12 |" in (tmp_path / "report.md").read_text()


# What stands in for a GPU machine: every step writes its record at once, but one, which hangs.
PYTHON = f"""#!/bin/bash
case "$1" in
*/report.py) exec {sys.executable} "$@" ;;
*/tests/gpu/*.py)
    name=$(basename "$1" .py)
    [ "$name" = "$STUCK" ] && sleep 60
    while [ "$1" != --out ]; do shift; done
    echo "{{\\"is\\": \\"$name\\"}}" >"$2" ;;
-) [ "$STUCK" = doctor ] && sleep 60
    echo '{{"ok": true}}' >"$work/doctor.json" ;;
-c) [[ "$2" = *"as it came"* ]] && exit 1 ;;
esac
exit 0
"""
CMAKE = """#!/bin/bash
[ "$STUCK" = build ] && sleep 60
exit 0
"""
SANITIZER = """#!/bin/bash
[ "$1" = --help ] && exit 0
[ "$STUCK" = "$2" ] && sleep 60
if [ "$2" = initcheck ]; then
    echo "========= Uninitialized __global__ memory read of size 4 bytes"
    echo "=========     at void ${READER:-at::native::add}<float>(int)+0x3a0"
    echo "========= ERROR SUMMARY: 1 error"
else
    echo "ERROR SUMMARY: 0 errors"
fi
"""
CHECKERS = ["memcheck", "racecheck", "initcheck", "synccheck", "replay"]
STEPS = ["build", "doctor", "headline", "parity", "timing", "graph", *CHECKERS[:4], "training"]
DEFAULT = ["headline", "training"]


@pytest.mark.parametrize(
    "stuck", [s if s in DEFAULT else pytest.param(s, marks=pytest.mark.slow) for s in STEPS]
)
def test_a_step_that_hangs_takes_no_other_step_s_record_along(tmp_path: Path, stuck: str) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, text in (("python", PYTHON), ("cmake", CMAKE), ("compute-sanitizer", SANITIZER)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHON": str(tools / "python"),
        "STUCK": stuck,
        "SECONDS_A_STEP": "1",
        "TMPDIR": str(tmp_path),
    }
    out = tmp_path / "out"
    done = subprocess.run(
        ["bash", str(CHECKS / "run_all.sh"), "-o", str(out)],
        env=environment, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    steps = json.loads((out / "report.json").read_text())["steps"]
    status = {name: step["status"] for name, step in steps.items()}
    ended = {stuck, "replay"} if stuck == "memcheck" else {stuck}  # the same tool
    assert {name for name, word in status.items() if word == "out of time"} == ended, done.stdout
    assert [n for n, word in status.items() if word != "ok" and n not in ended] == []
    for name in ("headline", "parity", "timing", "graph", "training"):
        assert (steps[name].get("record") == {"is": name}) == (name != stuck)
    assert done.returncode == (stuck not in CHECKERS)
    files = sorted(path.name for path in out.iterdir())
    assert len(files) == 8 and {"report.md", "report.json"} < set(files)
    assert not [path for path in tmp_path.iterdir() if path not in (tools, out)]


@pytest.mark.parametrize(
    ("reader", "code"),
    [
        ("at::native::add", 0),
        ("at_cuda_detail::cub::Scan", 0),
        ("refdgs::cuda::enter", 9),
        ("cub::DeviceScan", 9),
    ],
)
def test_initcheck_fails_for_reads_of_kernels_that_are_not_torchs(
    tmp_path: Path, reader: str, code: int
) -> None:
    tool = tmp_path / "compute-sanitizer"
    tool.write_text(SANITIZER)
    tool.chmod(0o755)
    lines = (CHECKS / "run_all.sh").read_text().splitlines()
    begin = lines.index("unwritten() {")
    function = "\n".join(lines[begin : lines.index("}", begin) + 1])
    done = subprocess.run(
        ["bash", "-c", f"{function}\nunwritten initcheck parity.py"],
        env={"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "READER": reader, "STUCK": "",
             "work": str(tmp_path), "python": "python"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == code
    assert f"1 read in void {reader}" in done.stdout and "ERROR SUMMARY" in done.stdout


TOLD = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'void refdgs::cuda::enter<refdgs::cuda::DrawTiles<float, 8, 2> >(refdgs::cuda::DrawTiles<float, 8, 2>)' for 'sm_90'
ptxas info    : Function properties for void refdgs::cuda::enter<refdgs::cuda::DrawTiles<float, 8, 2> >
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 64 registers, used 0 barriers, 10240 bytes smem, 752 bytes cmem[0]
ptxas info    : Compiling entry function 'void refdgs::cuda::enter<refdgs::cuda::MlpForward<float, refdgs::cuda::MmaProduct> >(refdgs::cuda::MlpForward<float, refdgs::cuda::MmaProduct>)' for 'sm_80'
    8 bytes stack frame, 4 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 83 registers, used 1 barriers, 368 bytes cmem[0]
ptxas info    : Compiling entry function 'void cub::DeviceScan<int>(int)' for 'sm_90'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 9 registers
"""  # noqa: E501


def test_the_table_of_registers_has_every_kernel_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(CHECKS))
    registers = importlib.import_module("registers")
    found = registers.uses(TOLD)
    assert found == {
        ("DrawTiles 8 2", 90): (64, 10240, 0),
        ("MlpForward MmaProduct", 80): (83, 0, 16),
    }
    rows = registers.table(found)
    assert "| DrawTiles 8 2 | - | - | - | 64 | - | - | 10,240 |" in rows
    assert "| MlpForward MmaProduct | 83 | - | - | - | - | - | 0 |" in rows


def test_the_script_is_sound() -> None:
    assert subprocess.run(["bash", "-n", str(CHECKS / "run_all.sh")], check=False).returncode == 0
