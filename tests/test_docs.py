"""The documents say what is: commands, exit codes and files that exist."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from refdgs_pipe import errors, recipe
from refdgs_pipe.cli.app import app
from refdgs_pipe.cli.running import DEGRADED

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text("utf-8")
DOCS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def readme_commands() -> list[str]:
    """Every call of refdgs-pipe in the README's code blocks, without its comment."""
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    lines = "\n".join(blocks).splitlines()
    calls = [line.partition("#")[0].split("&&")[-1].strip() for line in lines]
    return [call for call in calls if "refdgs-pipe" in call]


@pytest.mark.parametrize("command", readme_commands())
def test_every_command_of_the_readme_exists_with_its_options(command: str) -> None:
    arguments = shlex.split(command)[1:]
    with pytest.raises(SystemExit) as end:
        app([*arguments, "--help"], prog_name="refdgs-pipe")
    assert end.value.code == 0


def test_the_readme_shows_every_command() -> None:
    shown = {shlex.split(command)[1] for command in readme_commands()}
    helped = subprocess.run(
        [sys.executable, "-m", "refdgs_pipe.cli.app", "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    commands = re.findall(r"^  ([a-z]+)  ", helped.partition("Commands:")[2], re.MULTILINE)
    assert set(commands) == shown


def test_the_readme_lists_every_exit_code() -> None:
    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)}
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    codes = {kind.exit_code for kind in kinds if issubclass(kind, errors.RefdgsError)}
    assert listed == codes | {0, 2, DEGRADED}


def test_the_readme_names_every_recipe() -> None:
    assert all(name in README for name in recipe.names())


@pytest.mark.parametrize("document", DOCS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_a_document_links_or_runs_is_there(document: Path) -> None:
    text = document.read_text("utf-8")
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    scripts = re.findall(r"(?:\./)?((?:examples|\.ci)/[\w./-]+)", text)
    missing = [name for name in links if not (document.parent / name).exists()]
    missing += [name for name in scripts if not (ROOT / name.rstrip("./")).exists()]
    assert missing == []


def test_every_dependency_has_its_line() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = [lines for name, lines in project["optional-dependencies"].items() if name != "dev"]
    lines = [*project["dependencies"], *(line for lines in extras for line in lines)]
    names = {re.split(r"[<>=;\[ ]", line)[0] for line in lines}
    text = (ROOT / "docs" / "dependencies.md").read_text("utf-8")
    assert [name for name in names - {"open3d"} if name not in text] == []


def test_every_pinned_version_fits_and_nothing_is_unpinned() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(line for lines in extras for line in lines)]
    pins = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    )
    assert pins["torch"] == "2.13.0"
    for line in wanted:
        name = re.split(r"[<>=;\[ ]", line)[0]
        assert name in pins or name == "open3d", f"{name} is not pinned"
