"""What --json prints is what the published schemas say, for every command."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
import typer
from batches import BatchShell
from captures import write_photos
from shells import Shell

from refdgs_pipe.artifacts.scores import MaterialScore, PartScore, Scores, SurfaceScore, ViewScore
from refdgs_pipe.cli import doctor, evaluation
from refdgs_pipe.cli.app import app

SCHEMAS = Path(__file__).parent.parent.parent / "docs" / "schemas"
GROUPS = ("recipe", "batch", "cache")  # commands that have commands
USED_BY = {  # command -> the schemas of what it prints
    "run": ("run", "plan"),
    "rerun": ("run",),
    "status": ("status",),
    "verify": ("verify",),
    "clean": ("clean",),
    "eval": ("eval",),
    "bench": ("bench",),
    "doctor": ("doctor",),
    "check": ("check",),
    "batch status": ("batch-status",),
    "recipe list": ("recipe-list",),
    "recipe show": ("recipe-show",),
}


def holds(name: str, record: Any) -> None:
    """Fail where a record is not what its schema says."""
    schema = json.loads((SCHEMAS / f"{name}.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(record, schema, jsonschema.Draft202012Validator)


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    """What a command prints in this process."""
    with pytest.raises(SystemExit):
        app([*arguments, "--json"], prog_name="refdgs-pipe")
    return json.loads(capsys.readouterr().out)


class Scored:
    """A workspace whose last stage gave these scores."""

    root = Path("work")

    def __init__(self) -> None:
        self.manifest = SimpleNamespace(measures=(("render rate", 9.5, "views/s"),), seconds=3.0)

    def result(self, _: str) -> tuple[Any, Path]:
        return SimpleNamespace(manifest=self.manifest), Path()

    def status(self) -> list[Any]:
        return [SimpleNamespace(stage=SimpleNamespace(name="evaluate"), manifest=self.manifest)]


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


def test_every_command_with_json_has_a_schema_and_no_schema_is_without_a_command() -> None:
    group: Any = typer.main.get_command(app)
    commands = {
        **{name: command for name, command in group.commands.items() if name not in GROUPS},
        **{f"{g} {name}": c for g in GROUPS for name, c in group.commands[g].commands.items()},
    }
    with_json = {
        name
        for name, command in commands.items()
        if any("--json" in option.opts for option in command.params)
    }
    assert with_json == set(USED_BY)
    used = {schema for names in USED_BY.values() for schema in names} | {"error"}
    assert {path.stem for path in SCHEMAS.glob("*.json")} == used


def test_what_a_workspace_prints_is_what_the_schemas_say(shell: Shell) -> None:
    (shell.letters / "c.txt").write_text("odd")
    holds("plan", shell.json("run", "letters", "--dry-run"))
    holds("run", shell.json("run", "letters"))
    holds("run", shell.json("rerun", "letters.refdgs", "shout"))
    holds("status", shell.json("status", "letters.refdgs", "--set", "shout.marks=3"))
    holds("run", shell.json("run", "letters.refdgs", "--set", "shout.marks=3"))
    holds("verify", shell.json("verify", "letters.refdgs"))
    holds("clean", shell.json("clean", "letters.refdgs", "--dry-run"))
    holds("clean", shell.json("clean", "letters.refdgs"))
    holds("error", shell.json("status", "nowhere", code=64))


def test_a_bench_prints_what_its_schema_says(tmp_path: Path) -> None:
    shell = Shell(tmp_path)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.txt").write_text("diverging")
    record = shell.json("bench", "letters", "bad", "--out", "out", code=67, FAKE_BENCH="1")
    assert {cell["status"] for cell in record["cells"]} == {"done", "failed"}
    holds("bench", record)


def test_the_status_of_a_batch_is_what_its_schema_says(tmp_path: Path) -> None:
    shell = BatchShell(tmp_path)
    shell.init(ball="hello", bad="unusable", cup="fail 28", vase="world")
    shell.step("bad", "prepare")
    shell.step("cup", "prepare", code=73)
    for part in ("prepare", "train", "finish"):
        shell.step("ball", part)
    record = shell.json("batch", "status", "B")
    holds("batch-status", record)
    assert record["counts"] == {
        "done": 1,
        "running": 0,
        "waiting": 1,
        "to retry": 1,
        "failed": 1,
    }


def test_recipes_are_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    found = printed(capsys, "recipe", "list")
    holds("recipe-list", found)
    assert [entry["name"] for entry in found["recipes"] if entry["default"]] == ["glossy"]
    holds("recipe-show", printed(capsys, "recipe", "show", "preview"))


def test_the_doctor_prints_one_object(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "LIBRARIES", {"safetensors": "safetensors"})
    monkeypatch.setattr(doctor, "OPTIONAL", {"no_such_library": ("extra", "nothing")})
    record = printed(capsys, "doctor")
    holds("doctor", record)
    assert {"python", "safetensors", "no_such_library"} <= {f["name"] for f in record["findings"]}


@pytest.mark.parametrize("is_known", [True, False])
def test_scores_are_what_their_schema_says(
    is_known: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = Scores("train", (ViewScore("a", 30.0, 30.5, 0.95),), notes={"lpips": "no weights"})
    if is_known:
        surface = SurfaceScore(2.0, 0.0062, 0.005, 0.004, 0.006, 0.9, 1.0, 0.003, 0.002, 0.02, 0.03)
        part = PartScore("lid", 900, 0.25, 0.2, 0.06, 0.9, 1.0, 0.85)
        material = MaterialScore(0.08, 0.9, 0.85, (part,))
        scores = Scores("test", scores.views, surface, {"geometry": 20}, {}, material)
    monkeypatch.setattr(evaluation, "bring_up_to", lambda *_: None)
    monkeypatch.setattr(evaluation, "open_for_scores", lambda *_: Scored())
    monkeypatch.setattr(evaluation.Scores, "load", staticmethod(lambda _: scores))
    holds("eval", printed(capsys, "eval", "work"))


def test_a_check_prints_what_its_schema_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_photos(tmp_path / "photos", 3)
    (tmp_path / "photos" / "bad.jpg").write_bytes(b"\xff\xd8\xff\xe0 and no more")
    record = printed(capsys, "check", str(tmp_path / "photos"), "-q", "--threads", "1")
    holds("check", record)
    assert record["placement"] is not None
