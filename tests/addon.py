"""The Blender add-on without Blender, and a program that plays refdgs-pipe for it."""

import importlib
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from scenes import orbit

from refdgs_pipe.camera import Camera

ROOT = Path(__file__).parent.parent
BUILDER = ROOT / "examples" / "blender" / "build.py"
SOURCE = ROOT / "examples" / "blender" / "refdgs_pipe_blender"

FAKE = """\
import json, os, signal, sys, time
from pathlib import Path

arguments = sys.argv[1:]
if arguments[:2] == ["recipe", "list"]:
    names = ["preview", "new-one", "paper-real"]
    print(json.dumps({"recipes": [{"name": name, "about": name + "!"} for name in names]}))
    sys.exit(0)
photos = Path(arguments[-1])
named = dict(zip(arguments, arguments[1:]))
root = Path(named.get("--workspace", f"{photos}.refdgs"))
mode = named.get("--recipe", "fine")
(root / "logs").mkdir(parents=True, exist_ok=True)
(root / "argv.json").write_text(json.dumps(arguments))
log = (root / "logs" / f"20260101-000000-{os.getpid()}.jsonl").open("w", buffering=1)

def write(event, **record):
    print(json.dumps({"time": time.time(), "event": event, **record}), file=log)

def say(text):
    print(text, file=sys.stderr, flush=True)

def fail(kind, code, message):
    print(json.dumps({"status": "failed", "kind": kind, "exit_code": code, "message": message}))
    say(f"error: {message}")
    sys.exit(code)

def stop(*_):
    say("stopping at the next safe point (Ctrl-C again: stop at once)")
    (root / "stopped").write_text("by a signal")
    fail("Cancelled", 130, "stopped in train")

signal.signal(signal.SIGINT, stop)
if mode == "usage":
    say("Error: No such option: --sizes")
    sys.exit(2)
write("run", workspace=str(root), settings={})
say("train: learning shape")
write("started", stage="train", reason="never run", expected_s=None)
write("progress", stage="train", label="training", done=10, total=40, note="", work=None)
say("train: training 10/40, loss 0.1  30 dB, about 3 min left in all")
if mode == "wait":
    while True:
        time.sleep(0.05)
if mode == "fail":
    fail("CaptureError", 65, "3 photos: at least 8 are needed. Take more")
if mode == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
write("finished", stage="train", seconds=1.0)
verdict = {"word": "good", "line": "good, ready to use", "score": 1.0, "reasons": []}
print(json.dumps({"status": "ok", "workspace": str(root), "verdict": verdict}))
"""


def module(name: str) -> ModuleType:
    """A module of the add-on that needs no bpy. The package itself is never run: it needs bpy."""
    package = sys.modules.get(SOURCE.name)
    if package is None:
        package = ModuleType(SOURCE.name)
        package.__path__ = [str(SOURCE)]
        sys.modules[SOURCE.name] = package
    return importlib.import_module(f"{SOURCE.name}.{name}")


def fake_program(folder: Path) -> Path:
    """A program named refdgs-pipe, which does what the name of its recipe says."""
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "refdgs-pipe"
    program.write_text(f"#!{sys.executable}\n{FAKE}", "utf-8")
    program.chmod(0o755)
    return program


def shifted() -> list[Camera]:
    """Cameras of 200 x 160 and 120 x 160 pixels, whose axes do not pass through the middle."""
    made = []
    for camera, width, cx, cy in zip(orbit(2), (200, 120), (90.0, 66.0), (85.0, 70.0), strict=True):
        K = camera.K.copy()
        K[:2, 2] = cx, cy
        made.append(replace(camera, width=width, K=K))
    return made


def wait_for(found: object, timeout_s: float = 30.0) -> object:
    """What a function returns, once it is true."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := found():  # type: ignore[operator]
            return value
        time.sleep(0.02)
    raise AssertionError(f"it did not happen within {timeout_s:g} s")
