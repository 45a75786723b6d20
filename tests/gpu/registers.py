"""Registers and shared memory of every CUDA kernel: the table of docs/cuda.md.

python tests/gpu/registers.py [--write docs/cuda.md]

Compiles each file of csrc/cuda for each GPU (nvcc and c++filt must be on the PATH; two minutes on
two cores). Without --write it prints the table. It ends with 1 if a kernel of ours spills registers
or uses a stack.
"""

import argparse
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent.parent
ARCHS = (80, 86, 89, 90, 100, 120)
HEAD = "| kernel | " + " | ".join(f"sm_{arch}" for arch in ARCHS) + " | shared, bytes |"
LINE = "|---|" + "---:|" * (len(ARCHS) + 1)
ENTRY = re.compile(
    r"Compiling entry function '.*?enter<refdgs::cuda::(\w+)<float(.*?)> ?>\(.*?' for 'sm_(\d+)'"
)
STACK = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers(?:.*?, (\d+) bytes smem)?")


class Use(NamedTuple):
    """What a kernel takes on one GPU: registers of a thread, bytes of a block."""

    registers: int
    shared: int
    lost: int  # bytes of stack and spills


def uses(told: str) -> dict[tuple[str, int], Use]:
    """Of each kernel and GPU, from what ptxas says, demangled."""
    found: dict[tuple[str, int], Use] = {}
    at: tuple[str, int] | None = None
    lost = 0
    for line in told.splitlines():
        if entry := ENTRY.search(line):
            sizes = re.findall(r"(?<![\w])\d+", entry[2])
            kind = re.findall(r"refdgs::cuda::(\w+)", entry[2])
            at, lost = (" ".join([entry[1], *sizes, *kind]), int(entry[3])), 0
        elif "Compiling entry function" in line:
            at = None
        elif stack := STACK.search(line):
            lost = sum(int(n) for n in stack.groups())
        elif at and (used := USED.search(line)):
            found[at] = Use(int(used[1]), int(used[2] or 0), lost)
    return found


def compiled(source: Path, arch: int) -> dict[tuple[str, int], Use]:
    """One file for one GPU."""
    command = ["nvcc", "-std=c++17", "-O3", "--expt-relaxed-constexpr", f"-arch=sm_{arch}"]
    command += ["-Xptxas", "-v", "-cubin", "-o", "/dev/null", "-I", str(ROOT / "csrc"), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    names = subprocess.run(
        ["c++filt"], input=done.stderr, capture_output=True, text=True, check=True
    )
    return uses(names.stdout)


def table(found: dict[tuple[str, int], Use]) -> list[str]:
    """A row for each kernel."""
    rows = [HEAD, LINE]
    for name in sorted({name for name, _ in found}, key=_order):
        each = [found.get((name, arch)) for arch in ARCHS]
        numbers = [str(use.registers) if use else "-" for use in each]
        shared = max(use.shared for use in each if use)
        rows.append(f"| {name} | {' | '.join(numbers)} | {shared:,} |")
    return rows


def _order(name: str) -> list[tuple[int, str]]:
    return [(int(w), "") if w.isdigit() else (-1, w) for w in name.split()]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    sources = sorted((ROOT / "csrc" / "cuda").glob("*.cu"))
    jobs = [(source, arch) for source in sources for arch in ARCHS]
    found: dict[tuple[str, int], Use] = {}
    with ThreadPoolExecutor(2) as pool:
        for k, part in enumerate(pool.map(lambda job: compiled(*job), jobs)):
            found |= part
            print(f"\r{k + 1} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    rows = table(found)
    if options.write is None:
        print("\n".join(rows))
    else:
        text = options.write.read_text()
        old = re.search(r"\| kernel [^\n]*sm_80.*?(?=\n(?!\|)|\Z)", text, re.DOTALL)
        if old is None:
            print(f"{options.write} has no such table", file=sys.stderr)
            return 1
        options.write.write_text(text[: old.start()] + "\n".join(rows) + text[old.end() :])
    bad = [
        f"{name} on sm_{arch}: {use.lost} bytes" for (name, arch), use in found.items() if use.lost
    ]
    print("\n".join(bad) if bad else "no kernel spills or uses a stack", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
