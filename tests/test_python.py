"""The package as Python programs use it: what docs/python.md says holds."""

import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import fake_stages
import pytest
from fake_stages import Letters
from PIL import Image
from test_architecture import HEAVY
from test_end_to_end import write_capture

import refdgs_pipe
from refdgs_pipe.cli import libraries
from refdgs_pipe.errors import Cancelled, DeviceError, InputError
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.pipeline.events import Event, Progress, Started
from refdgs_pipe.reporting import asset as turntable

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "python.md").read_text("utf-8")


def python(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_importing_the_package_loads_no_library() -> None:
    code = "import sys, refdgs_pipe; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = set(python("-c", code).split())
    assert loaded & (HEAVY | {"numpy", "pydantic", "typer", "rich"}) == set()


def test_every_public_name_is_there_and_others_are_not() -> None:
    assert all(getattr(refdgs_pipe, name) is not None for name in refdgs_pipe.__all__)
    assert set(refdgs_pipe.__all__) <= set(dir(refdgs_pipe))
    with pytest.raises(AttributeError, match="no attribute 'rum'"):
        refdgs_pipe.rum  # noqa: B018


def test_the_page_names_every_public_name() -> None:
    names = set(refdgs_pipe.__all__) - {"__version__"}
    assert {name for name in names if not re.search(rf"\b{name}\b", PAGE)} == set()


def test_the_package_can_be_run_as_the_command_line() -> None:
    assert python("-m", "refdgs_pipe", "--version").strip() == refdgs_pipe.__version__


@pytest.mark.timeout(900)  # half a minute on an idle machine, and it trains
def test_the_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(turntable, "_FRAME", 40)  # of the report; takes most of the time
    monkeypatch.setattr(turntable, "_CLOSE_UP", 40)
    run, least = refdgs_pipe.run, {"start.look_steps": 20, "appearance.light": 16}

    def quick(*photos: Any, settings: dict[str, Any] | None = None, **how: Any) -> Any:
        return run(*photos, settings=least | settings if settings else None, **how)

    monkeypatch.setattr(refdgs_pipe, "run", quick)  # more steps of the same prove no more
    write_capture(tmp_path / "photos", count=12)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, "docs/python.md", "exec"), names)
    result = names["result"]
    assert isinstance(result, refdgs_pipe.Result)
    assert result.asset == tmp_path / "photos.refdgs" / "asset"
    assert (result.asset / "asset.glb").is_file() and result.report is not None
    assert Image.open("view.png").size == (64, 64)
    assert refdgs_pipe.run("photos.refdgs", report=False).made == {}


@pytest.fixture
def letters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Input of the small stages, which stand in for the real ones."""
    stages = list(fake_stages.STAGES)
    monkeypatch.setattr(catalog, "load_stages", lambda names=(): stages)
    monkeypatch.setattr(catalog, "source_type", lambda stages: Letters)
    folder = tmp_path / "letters"
    folder.mkdir()
    (folder / "a.txt").write_text("odd")
    return folder


def test_a_run_prints_nothing_and_returns_what_it_came_to(
    letters: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    events: list[Event] = []
    result = refdgs_pipe.run(
        letters, settings={"shout.mood": "very glad"}, listen=events.append, report=False
    )
    assert capfd.readouterr() == ("", "")
    assert [e.stage for e in events if isinstance(e, Started)] == ["read", "shout", "export"]
    assert list(result.made) == ["read", "shout", "export"]
    assert result.workspace == letters.with_name("letters.refdgs")
    assert result.measures["read"] == {"letters": 1} and result.warnings == ("an odd letter",)
    again = refdgs_pipe.run(result.workspace, again=["shout"], until="shout", report=False)
    assert list(again.made) == ["shout"] and again.asset is None


def test_several_files_and_a_workspace_elsewhere_are_taken(letters: Path, tmp_path: Path) -> None:
    (letters / "b.txt").write_text("b")
    files = [str(letters / name) for name in ("a.txt", "b.txt")]
    result = refdgs_pipe.run(files, workspace=tmp_path / "work", report=False)
    assert result.workspace == tmp_path / "work"
    assert result.measures["read"]["letters"] == 2


def test_a_run_can_be_stopped_and_goes_on_later(letters: Path) -> None:
    stop = threading.Event()

    def listen(event: Event) -> None:
        if isinstance(event, Progress) and event.note == "loudness 6":
            stop.set()

    with pytest.raises(Cancelled, match="run again to go on"):
        refdgs_pipe.run(letters, listen=listen, stop=stop, report=False)
    result = refdgs_pipe.run(letters, report=False)
    assert result.measures["shout"]["resumed at"] == 7


def test_nothing_is_made_where_a_later_stage_could_not_load_its_library(
    letters: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = {"no_such_module": {"libnone.so.1": "libnone1"}}
    monkeypatch.setattr(libraries, "SYSTEM", missing)
    monkeypatch.setattr(libraries, "LIBRARIES", {"no_such_module": "pydantic"})
    events: list[Event] = []
    with pytest.raises(DeviceError, match="apt-get install libnone1"):
        refdgs_pipe.run(letters, listen=events.append, report=False)
    assert events == []


def test_a_setting_that_is_none_any_more_is_a_warning(letters: Path) -> None:
    with pytest.warns(UserWarning, match="shout.volume is now the option"):
        refdgs_pipe.run(letters, settings={"shout.volume": "high"}, report=False)


def test_mistakes_are_errors_that_say_what_to_do(letters: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none were given"):
        refdgs_pipe.run([])
    with pytest.raises(InputError, match="leave it out, and it has its default"):
        refdgs_pipe.run(letters, settings={"shout.marks": None})
    with pytest.raises(refdgs_pipe.RefdgsError, match="not a workspace"):
        refdgs_pipe.load_field(tmp_path)
