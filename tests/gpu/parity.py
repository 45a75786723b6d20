"""Every operation on the GPU in float32 against the CPU in float64, and against itself.

python tests/gpu/parity.py --out FILE [--device cuda|emulated] [--small] [--once] [--only CASE]

FILE is written after every case. A case that fails on the GPU can take its context with it: then
it is run again where every launch is waited for, to name the kernel, and the rest in a new process.
"""

import argparse
import faulthandler
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
from cases import cases  # noqa: E402
from jobs import Run, drawing, fused  # noqa: E402

LIMIT = 1e-4  # relative error by norm
# Single rows (pixels, surfels) are beyond float32: a pixel at a cut-off falls on either side, a
# disc seen edge-on has a determinant of rounding. These are left out before the norm is taken, and
# where the CPU's float32 is still above the limit, it is the measure. All rows together have a
# limit too, so that what is left out is single rows and not a tile.
OUTLIERS = 0.003
WHOLE = 3e-3  # relative error of all rows
ROUGH = {"network, bfloat16": 0.1}  # limits of cases that round on purpose
AS_GOOD = 3.0
REPEATS = 3
HANGS = 60.0  # seconds after which the log says where a case hangs
BEYOND = 1e30  # the error of what did not come to an end
EXPLAINED = 2  # failures that are run again to name their kernel


def error_of(found: Tensor, wanted: Tensor) -> tuple[float, float]:
    """|found - wanted| / |wanted| by norm: without the outliers, and of all.

    0 where both are empty or zero.
    """
    width = wanted.shape[-1] if wanted.ndim > 1 and wanted.shape[-1] <= 20 else 1
    rows = (found.double().cpu() - wanted).reshape(-1, width).norm(dim=1).sort().values
    norm = float(wanted.norm()) or 1.0
    kept = rows[: len(rows) - int(OUTLIERS * len(rows))]
    return float(kept.norm()) / norm, float(rows.norm()) / norm


def check(
    name: str, run: Run, device: str, on: Callable[[], Any], repeats: int
) -> list[dict[str, Any]]:
    """One row for each output and gradient."""
    wanted, usual = run(torch.float64, "cpu"), run(torch.float32, "cpu")
    found = []
    for _ in range(repeats):
        with on():
            found.append(run(torch.float32, device))
    rows = []
    for output, value in wanted.items():
        error, whole = error_of(found[0][output], value)
        theirs, their_whole = error_of(usual[output], value)
        same = all(torch.equal(found[0][output], other[output]) for other in found[1:])
        if output == "d/d pose":  # a sum over all surfels, outliers and all: as exact as its terms
            terms = wanted["d/d means"]
            theirs = max(theirs, *(error_of(r["d/d means"], terms)[1] for r in (usual, found[0])))
        row = {"case": name, "output": output, "error": error, "with outliers": whole}
        row |= {"cpu float32": theirs, "cpu float32 with outliers": their_whole}
        limit, limit_of_all = ROUGH.get(name, LIMIT), ROUGH.get(name, WHOLE)
        ok = error <= max(limit, AS_GOOD * theirs)
        ok &= whole <= max(limit_of_all, AS_GOOD * max(theirs, their_whole))
        rows.append({**row, "within": ok, "same every time": same, "ok": ok and same})
    return rows


def failed(name: str, why: str) -> dict[str, Any]:
    """The row of a case that raised."""
    row = {"case": name, "output": "-", "error": BEYOND, "cpu float32": 0.0}
    return {**row, "same every time": False, "ok": False, "why": why}


def explained(name: str, options: argparse.Namespace) -> str:
    """What a case says in a process of its own that waits for every launch."""
    command = [sys.executable, __file__, "--only", name, "--once", "--out", os.devnull]
    blocking = {**os.environ, "CUDA_LAUNCH_BLOCKING": "1"}
    try:
        done = subprocess.run(
            [*command, *(["--small"] if options.small else [])],
            env=blocking, capture_output=True, text=True, timeout=40, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "alone, it does not end within 40 s"
    return "alone: " + (done.stdout + done.stderr)[-700:]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--once", action="store_true", help="no repeats")
    parser.add_argument("--only", help="this case alone")
    parser.add_argument("--start", type=int, default=0, help="go on with this case")
    options = parser.parse_args()
    device, on = options.device, nullcontext
    if device == "emulated":
        from emulation import emulated

        device, on = "cpu", emulated
    jobs = {case.name: drawing(case) for case in cases(small=options.small)}
    jobs["random, planned"] = drawing(cases(small=options.small)[0], planned=True)
    jobs["random, through a lens"] = drawing(cases(small=options.small)[0], lens=True)
    jobs |= fused(small=options.small)
    begin, rows, spent = time.monotonic(), [], 0.0
    if options.start:
        record = json.loads(options.out.read_text())
        rows, spent = record["rows"], record["seconds"]
    for index, (name, run) in enumerate(jobs.items()):
        if index < options.start or (options.only and name != options.only):
            continue
        print(f"{time.monotonic() - begin:6.1f} s  {name}", flush=True)
        broken = None
        faulthandler.dump_traceback_later(HANGS)
        try:
            rows += check(name, run, device, on, 1 if options.once else REPEATS)
        except Exception as error:
            traceback.print_exc()
            broken = f"{type(error).__name__}: {error}"[:700]
        faulthandler.cancel_dump_traceback_later()
        if broken and device == "cuda" and not options.only:
            if sum("why" in row for row in rows) < EXPLAINED:
                broken += "\n" + explained(name, options)
            print(broken, flush=True)
        if broken:
            rows.append(failed(name, broken))
        seconds = spent + time.monotonic() - begin
        record = {"ok": all(row["ok"] for row in rows), "limit": LIMIT, "seconds": seconds}
        record |= {"cases": len(jobs), "rows": rows}
        options.out.write_text(json.dumps(record, indent=1))
        if broken and device == "cuda" and not options.only:
            again = [__file__, *sys.argv[1:], "--start", str(index + 1)]
            os.execv(sys.executable, [sys.executable, *again])
    return verdict(rows)


def verdict(rows: list[dict[str, Any]]) -> int:
    """Says what is not as it should be; 1 if there is such."""
    for row in rows:
        if not row["ok"]:
            print("FAILED", row)
    ok = bool(rows) and all(row["ok"] for row in rows)
    worst = max((row["error"] for row in rows), default=BEYOND)
    all_of = "all" if ok else "NOT all"
    print(f"{len(rows)} outputs, worst error {worst:.2e}, {all_of} as they should be")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
