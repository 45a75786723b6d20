"""One JSON and one Markdown report of what the steps of run_all.sh left in a folder.

python tests/gpu/report.py FOLDER OUT
"""

import json
import sys
from pathlib import Path
from typing import Any

CHECKS = ("memcheck", "racecheck", "initcheck", "synccheck", "replay")
STEPS = ("build", "doctor", "headline", "parity", "timing", "graph", *CHECKS, "training")
OPTIONAL = CHECKS  # a machine may not let a checker near its GPU

REFUSALS = (
    "Device not supported",
    "StreamCaptureImplicit",
)  # the latter: it cannot watch recordings
IMPOSSIBLE, OUT_OF_TIME = "not possible on this machine", "out of time"


def read(folder: Path) -> dict[str, Any]:
    """Every step's exit code, seconds, record and last words."""
    out: dict[str, Any] = {}
    for step in STEPS:
        status = folder / f"{step}.status"
        if not status.exists():
            out[step] = {"status": IMPOSSIBLE if step in OPTIONAL else "not run"}
            continue
        code, seconds = status.read_text().split()
        found: dict[str, Any] = {"exit code": int(code), "seconds": int(seconds)}
        log = folder / f"{step}.said"
        text = log.read_text(errors="replace") if log.exists() else ""
        found["status"] = "ok" if code == "0" else OUT_OF_TIME if code == "124" else "failed"
        refused = "SUMMARY" not in text or any(words in text for words in REFUSALS)
        if step in OPTIONAL and code != "124" and refused:
            found["status"] = IMPOSSIBLE
        found["last words"] = text[-1500:]
        record = folder / f"{step}.json"
        if record.exists():
            try:
                found["record"] = json.loads(record.read_text())
            except ValueError:
                found["record"] = {"error": "cut off while it was written"}
        out[step] = found
    return out


def _parity(record: dict[str, Any]) -> list[str]:
    rows = record.get("rows", [])
    done = len(dict.fromkeys(row["case"] for row in rows))
    lines = [f"{done} of {record.get('cases', '?')} cases in {record.get('seconds', 0):.0f} s.", ""]
    lines += ["| case | outputs | worst error | which | CPU float32 there | same bits | ok |"]
    lines.append("|---|---:|---:|---|---:|---|---|")
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        worst = max(mine, key=lambda row: row["error"])
        same = all(row["same every time"] for row in mine)
        ok = all(row["ok"] for row in mine)
        lines.append(
            f"| {case} | {len(mine)} | {worst['error']:.1e} | {worst['output']} | "
            f"{worst['cpu float32']:.1e} | {'yes' if same else 'NO'} | {'yes' if ok else 'NO'} |"
        )
    lines += [f"\n{row['case']}: {row['why']}" for row in rows if "why" in row]
    above = [row for row in rows if row["ok"] and row["error"] > record["limit"]]
    for row in above:
        lines.append(
            f"\n{row['case']}, {row['output']}: {row['error']:.1e} is above {record['limit']:.0e}, "
            f"as is the CPU's own float32 ({row['cpu float32']:.1e})."
        )
    return lines


def _timing(record: dict[str, Any]) -> list[str]:
    if "rows" not in record:
        return _facts(record)
    lines = [f"* {problem}" for problem in record["problems"]]
    lines += [f"Copies reach {record['GB/s']:.0f} GB/s, products {record['TFLOP/s']:.1f} TFLOP/s."]
    lines += ["", "| operation | ms | floor, ms | times the floor |", "|---|---:|---:|---:|"]
    for row in record["rows"]:
        lines.append(
            f"| {row['what']} | {row['ms']:.3f} | {row['floor ms']:.3f} | "
            f"{row['times the floor']:.1f} |"
        )
    if record["kernels"]:
        lines += ["", "| kernel | calls | us a call |", "|---|---:|---:|"]
        for row in record["kernels"]:
            lines.append(f"| {row['kernel']} | {row['calls']} | {row['us']:.1f} |")
    return lines


def _headline(record: dict[str, Any]) -> list[str]:
    plain = {k: v for k, v in record.items() if k != "replay"}
    lines = _facts(plain)
    replay = record.get("replay")
    if replay:
        lines += ["", f"A replayed step: {replay['launches a step']:.0f} launches, "]
        lines[-1] += f"{replay['ms busy a step']:.2f} ms."
        lines += ["", "| kernel | launches | us a step |", "|---|---:|---:|"]
        for row in replay["kernels"]:
            lines.append(f"| {row['kernel']} | {row['calls']:.0f} | {row['us a step']:.1f} |")
    return lines


def _facts(record: dict[str, Any]) -> list[str]:
    return [f"* {name}: {value}" for name, value in record.items()]


def markdown(found: dict[str, Any]) -> str:
    """The report in words."""
    lines = ["# The CUDA backend on this machine", ""]
    lines += ["| step | status | seconds |", "|---|---|---:|"]
    for step, result in found.items():
        lines.append(f"| {step} | {result['status']} | {result.get('seconds', '')} |")
    for step, result in found.items():
        record = result.get("record")
        lines += ["", f"## {step}", ""]
        if record is not None:
            own = {"parity": _parity, "timing": _timing, "headline": _headline}
            describe = own.get(step, _facts)
            lines += describe(record)
        if record is None or result["status"] != "ok":
            lines += ["```", result.get("last words", "").strip()[-1200:], "```"]
    return "\n".join(lines) + "\n"


def main() -> int:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    found = read(folder)
    bad = [
        s
        for s, r in found.items()
        if r["status"] in ("failed", "not run")
        or (r["status"] == OUT_OF_TIME and s not in OPTIONAL)
    ]
    (out / "report.json").write_text(json.dumps({"ok": not bad, "steps": found}, indent=1))
    (out / "report.md").write_text(markdown(found))
    print(markdown(found))
    print("ok" if not bad else f"NOT ok: {', '.join(bad)}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
