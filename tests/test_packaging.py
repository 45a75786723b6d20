"""What is passed on: a wheel and an sdist that need no checkout."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LICENSES = {"LICENSE", "csrc/nanobind.LICENSE"}
LICENSES |= {"refdgs_pipe/reporting/assets/model-viewer-4.4.0.LICENSE"}
PARTS = {
    "refdgs_pipe/cli/batch/Snakefile",
    "refdgs_pipe/cli/batch/profiles/slurm.yaml",
    "refdgs_pipe/py.typed",
    "refdgs_pipe/recipes/glossy.toml",
    "refdgs_pipe/stages/train.py",
}
PARTS |= {"refdgs_pipe/reporting/assets/model-viewer-4.4.0.umd.min.js", "refdgs_pipe/api.py"}


def done(command: list[str], cwd: Path) -> str:
    """What a command prints, without the paths and settings of this test run."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment["SKBUILD_CMAKE_DEFINE"] = "REFDGS_CUDA=OFF"
    result = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, env=environment
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sdist")
    code = f"from scikit_build_core.build import build_sdist; build_sdist({str(out)!r})"
    done([sys.executable, "-c", code], ROOT)
    (path,) = out.glob("*.tar.gz")
    return path


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the sdist, in an empty folder."""
    empty = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "wheel", "--no-index", "--no-deps", "--no-build-isolation"]
    done([*pip, str(sdist)], empty)
    (path,) = empty.glob("*.whl")
    return path


@pytest.mark.slow
def test_an_sdist_has_the_sources_and_nothing_that_was_built(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"csrc/CMakeLists.txt", "stages/train.py", "recipes/glossy.toml", *LICENSES} <= names
    folders = {name.partition("/")[0] for name in names}
    assert folders & {"build", "dist", ".venv", ".git", "shared"} == set()
    assert not [name for name in names if name.endswith((".so", ".pyc"))]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_wheel_has_all_parts_and_every_licence_of_what_is_in_it(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        head = message_from_bytes(archive.read(metadata))
    assert names >= PARTS
    assert [name for name in names if name.startswith("_refdgs_native")]
    assert not [name for name in names if "tests/" in name or "emulated" in name]
    assert head["License-Expression"] == "Apache-2.0 AND MIT AND BSD-3-Clause"
    assert set(head.get_all("License-File") or []) == LICENSES
    folder = metadata.replace("METADATA", "licenses/")
    assert {folder + name for name in LICENSES} <= names


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_an_installed_wheel_works_from_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    done([sys.executable, "-m", "venv", "--without-pip", "fresh"], tmp_path)
    fresh = tmp_path / "fresh"
    python = str(fresh / "bin" / "python")
    install = ["pip", "--python", python, "install", "--no-index", "--no-deps", str(wheel)]
    done([sys.executable, "-m", *install], tmp_path)
    # a path in a .pth file is searched last, and its own .pth files are not read: the libraries
    # are there, the checkout is not
    (site,) = fresh.glob("lib/python*/site-packages")
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib"))
    empty = tmp_path / "empty"
    empty.mkdir()
    code = "import refdgs_pipe, _refdgs_native as n; print(refdgs_pipe.__file__, n.__file__)"
    assert done([python, "-c", code], empty).count(str(site)) == 2
    command = str(fresh / "bin" / "refdgs-pipe")
    assert "glossy" in done([command, "recipe", "list"], empty)
    assert "environment_height = 256" in done([command, "recipe", "show", "--resolved"], empty)
    assert done([python, "-m", "refdgs_pipe", "--version"], empty).strip()
    code = "import numpy as np, refdgs_pipe.ops as ops; print(ops.__file__)"
    assert str(site) in done([python, "-c", code], empty)
