"""What a run says of its result at its end."""

import json
from pathlib import Path

import fake_stages
import pytest

from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.cli import running
from refdgs_pipe.cli.running import Options
from refdgs_pipe.cli.verdict import closing_lines, is_draft, to_do, verdict_of
from refdgs_pipe.cli.workspace import Memory, Workspace, open_workspace
from refdgs_pipe.evaluation.verdict import Verdict, judged
from refdgs_pipe.pipeline import catalog

POOR = judged(
    ObjectFigures(photos=20, placed=8, psnr=12.0, training_psnr=24.0, seen=0.4, unseen=0.3)
)
FAIR = judged(ObjectFigures(photos=20, placed=20, psnr=24.0, training_psnr=24.5), draft=True)


@pytest.fixture
def space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    monkeypatch.setattr(catalog, "load_stages", lambda names=(): list(fake_stages.STAGES))
    monkeypatch.setattr(catalog, "source_type", lambda stages: fake_stages.Letters)
    letters = tmp_path / "letters"
    letters.mkdir()
    (letters / "a.txt").write_text("hello")
    (tmp_path / "first.toml").write_text("draft = true\n")
    memory = Memory((letters,), str(tmp_path / "first.toml"), ())
    return open_workspace(tmp_path / "letters.refdgs", memory)


def test_the_worst_is_said_first_and_what_to_do_about_it() -> None:
    lines = closing_lines(POOR)
    assert lines[0] == "verdict: poor"
    assert lines[1].startswith("  Many photos could not be used") and "(8 of 20)" in lines[1]
    assert lines[4] == "  and 1 more in the report"
    assert closing_lines(FAIR)[0] == "verdict: fair, a first look"


def test_what_to_do_begins_with_the_full_recipe_after_a_first_look(space: Workspace) -> None:
    steps = to_do(space, FAIR)
    command = f"refdgs-pipe run {space.memory.photos[0]} --recipe glossy"
    assert steps[0] == f"make it at full quality: {command}"
    assert steps[1].startswith("train longer") and len(steps) == len(set(steps))
    assert not any("full quality" in step for step in to_do(space, POOR))


@pytest.mark.parametrize(("verdict", "code"), [(POOR, 3), (FAIR, 0), (None, 0)])
def test_strict_fails_on_a_poor_result(
    verdict: Verdict | None,
    code: int,
    space: Workspace,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(running, "verdict_of", lambda _: verdict)
    assert running.make(space, Options(strict=True)) == code
    said = capsys.readouterr().err
    assert ("verdict: " in said) == (verdict is not None)
    assert running.make(space, Options(json=True)) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["verdict"] == (verdict and verdict.record())
    if verdict is not None:
        assert record["verdict"]["word"] == verdict.word
        assert {"about", "word", "value", "advice", "plain"} == set(record["verdict"]["reasons"][0])


def test_a_pipeline_without_scores_has_no_verdict_and_recipes_say_what_is_a_draft(
    space: Workspace, tmp_path: Path
) -> None:
    assert verdict_of(space) is None
    assert is_draft(space)
    full = Memory(space.memory.photos, "glossy", ())
    assert not is_draft(open_workspace(tmp_path / "letters.refdgs", full))
