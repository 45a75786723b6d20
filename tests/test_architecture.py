"""The shape of the project, as tests. What each law is for stands in docs/architecture.md."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import pytest
from pydantic import BaseModel

from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.catalog import STAGES, load_stages

ROOT = Path(__file__).parent.parent
MODULE_LINES, FUNCTION_LINES, STAGE_LINES = 400, 60, 60
HEAVY = {
    "torch",
    "cv2",
    "pycolmap",
    "open3d",
    "pxr",
    "pymeshlab",
    "xatlas",
    "rawpy",
    "scipy",
    "PIL",
    "onnxruntime",
}


def modules() -> list[Path]:
    """Every Python file of the product."""
    folders = [ROOT / "refdgs_pipe", ROOT / "stages", ROOT / "recipes"]
    return sorted(path for folder in folders for path in folder.rglob("*.py"))


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def label(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_no_module_is_over_400_lines_and_no_stage_over_60() -> None:
    lengths = {label(path): len(path.read_text().splitlines()) for path in modules()}
    limits = {name: STAGE_LINES if name.startswith("stages/") else MODULE_LINES for name in lengths}
    assert {name: count for name, count in lengths.items() if count > limits[name]} == {}


def test_no_function_is_over_60_lines() -> None:
    long = {}
    for path in modules():
        for node in functions(ast.parse(path.read_text())):
            count = (node.end_lineno or 0) - node.lineno + 1
            if count > FUNCTION_LINES:
                long[f"{label(path)}:{node.name}"] = count
    assert long == {}


def test_every_module_and_public_function_says_what_it_is() -> None:
    silent = []
    for path in modules():
        tree = ast.parse(path.read_text())
        if path.name != "__init__.py" and not ast.get_docstring(tree):
            silent.append(label(path))
        for node in tree.body:
            public = isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
            if public and not ast.get_docstring(node):
                silent.append(f"{label(path)}:{node.name}")
    assert silent == []


def test_strict_types_are_asked_of_every_package_and_given_to_users() -> None:
    mypy = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]
    assert mypy["strict"]
    assert {label(path).partition("/")[0] for path in modules()} == set(mypy["packages"])
    assert (ROOT / "refdgs_pipe" / "py.typed").is_file()


def test_no_module_is_called_by_a_name_that_says_nothing() -> None:
    empty = {"utils", "util", "helpers", "common", "core", "base", "types", "misc"}
    assert [label(path) for path in modules() if path.stem in empty] == []


def test_nothing_is_left_for_later() -> None:
    marks = re.compile(r"\b(TODO|FIXME|XXX|NotImplementedError)\b")
    assert [label(path) for path in modules() if marks.search(path.read_text())] == []


def test_no_file_names_a_place_on_somebodys_machine() -> None:
    place = re.compile(r"/(home|root|work|Users)/\w")
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    texts = [
        name for name in tracked if name.endswith((".py", ".md", ".toml", ".cpp", ".h", ".sh"))
    ]
    found = [name for name in texts if place.search((ROOT / name).read_text("utf-8"))]
    assert found == []


def test_the_layers_hold(tmp_path: Path) -> None:
    """import-linter, on the package laid out as it is installed."""
    pytest.importorskip("importlinter")
    package = tmp_path / "refdgs_pipe"
    keep = shutil.ignore_patterns("__pycache__", "*.so")
    shutil.copytree(ROOT / "refdgs_pipe", package, ignore=keep)
    shutil.copytree(ROOT / "stages", package / "stages", ignore=keep)
    shutil.copytree(ROOT / "recipes", package / "recipes", ignore=keep)
    code = (
        "import sys; sys.path.insert(0, '.')\n"
        "from importlinter.cli import lint_imports\n"
        f"sys.exit(lint_imports(config_filename={str(ROOT / 'pyproject.toml')!r}, no_cache=True))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def modules_loaded_by(*arguments: str, code: int = 0) -> set[str]:
    """The top-level modules in memory after a command."""
    program = (
        "import sys\nfrom refdgs_pipe.cli.app import main\n"
        "try:\n    main()\n"
        "finally:\n"
        "    names = {name.partition('.')[0] for name in sys.modules}\n"
        "    print('\\nMODULES', *names, file=sys.stderr)\n"
    )
    paths = os.pathsep.join(path for path in sys.path if path)
    result = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert result.returncode == code, result.stdout + result.stderr
    return set(result.stderr.rpartition("MODULES ")[2].split())


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["recipe", "list"]])
def test_help_loads_nothing_heavy(arguments: list[str]) -> None:
    assert modules_loaded_by(*arguments) & (HEAVY | {"numpy"}) == set()


def test_status_and_a_plan_load_nothing_heavy(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"\xff\xd8")
    memory = {"photos": [["photos", str(photos)]], "recipe": "glossy", "set": []}
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "workspace.json").write_text(json.dumps(memory))
    assert modules_loaded_by("status", str(tmp_path / "work")) & HEAVY == set()
    assert modules_loaded_by("run", str(photos), "--dry-run") & HEAVY == set()
    assert modules_loaded_by("recipe", "show", "preview", "--resolved") & HEAVY == set()


def test_every_stage_is_a_file_of_its_own_name() -> None:
    files = {path.stem for path in (ROOT / "stages").glob("*.py")} - {"__init__"}
    assert files == set(STAGES)
    assert [stage.name for stage in load_stages()] == list(STAGES)


def test_a_stage_that_uses_a_device_says_in_its_record_which() -> None:
    uses = {p.stem for p in (ROOT / "stages").glob("*.py") if "job.device" in p.read_text()}
    assert {stage.name for stage in load_stages() if stage.by_device} == uses


def groups() -> list[type[Params]]:
    """Every group of settings that a stage takes, nested ones too."""
    found = [stage.params for stage in load_stages()]
    for group in found:
        for info in group.model_fields.values():
            for kind in (info.annotation, *get_args(info.annotation)):
                if isinstance(kind, type) and issubclass(kind, Params) and kind not in found:
                    found.append(kind)
    return found


def test_every_setting_has_a_default_a_meaning_and_limits() -> None:
    problems = []
    for group in groups():
        if not group.__doc__ or group.__doc__ == BaseModel.__doc__:
            problems.append(f"{group.__name__}: no docstring")
        for name, info in group.model_fields.items():
            if not info.description:
                problems.append(f"{group.__name__}.{name}: no description")
            if not is_limited(info.annotation, info.metadata):
                problems.append(f"{group.__name__}.{name}: no limits")
            if info.is_required():
                problems.append(f"{group.__name__}.{name}: no default")
    assert problems == []


def is_limited(kind: Any, rules: list[Any]) -> bool:
    """Whether the type or the rules leave only sensible values."""
    if get_origin(kind) is Literal or kind is bool:
        return True
    if isinstance(kind, type) and issubclass(kind, Params):
        return True
    if get_origin(kind) is tuple:
        return True
    if type(kind).__name__ == "UnionType" or get_origin(kind) is Union:
        return all(kind is type(None) or is_limited(kind, rules) for kind in get_args(kind))
    return any(hasattr(rule, limit) for rule in rules for limit in ("gt", "ge", "max_length"))


def test_every_setting_is_read_somewhere() -> None:
    read = {
        node.attr
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
    }
    unread = [
        f"{g.__name__}.{name}" for g in groups() for name in g.model_fields if name not in read
    ]
    assert unread == []


def test_every_library_that_is_imported_is_a_declared_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [
        line
        for name, lines in project["optional-dependencies"].items()
        for line in lines
        if name != "dev"
    ]
    lines = [*project["dependencies"], *extras]
    declared = {re.split(r"[<>=;\[ ]", line)[0].lower() for line in lines}
    names = {"cv2": "opencv-contrib-python-headless", "PIL": "pillow", "pxr": "usd-core"}
    names |= {"open3d": "open3d-cpu"}
    imported = set()
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.partition(".")[0])
    foreign = imported - set(sys.stdlib_module_names) - {"refdgs_pipe", "_refdgs_native"}
    assert {names.get(name, name) for name in foreign} - declared == set()
