"""What a quick look means: each finding in words, and a verdict that never promises too much."""

from dataclasses import replace
from pathlib import Path

import finished
import numpy as np
import pytest

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.views import Exif, Skipped, Views
from refdgs_pipe.checking.cost import cost
from refdgs_pipe.checking.early import early_lines
from refdgs_pipe.checking.findings import Finding, Verdict, findings_of, judge
from refdgs_pipe.checking.look import Look
from refdgs_pipe.checking.pixels import exposures_of
from refdgs_pipe.files.images import write_png
from refdgs_pipe.sfm.around import around
from refdgs_pipe.sfm.gate import Check, Judgement


def look_at(views: Views, placement: Placement | None = None, *, trusted: bool = True) -> Look:
    """A look whose try placed five of six photos."""
    model = finished.model()
    check = Check("photos with a trusted place", "5 of 6, 70% are needed", trusted, "Take more")
    gaps = ("between a and b there is a gap of 90 degrees",)
    judgement = Judgement(model, {finished.CAMERAS[5].name: "shares nothing"}, (check,), gaps)
    return Look(
        Path(),
        6,
        12.0,
        views,
        placement=placement or Placement(None),
        judgement=judgement,
        model=model,
        tried=views.items,
        exposures=exposures_of(views),
    )


def judged(look: Look) -> tuple[dict[str, Finding], Verdict]:
    findings = findings_of(look)
    return {finding.name: finding for finding in findings}, judge(look, findings)


def test_faults_are_named_with_photos_and_what_to_do(tmp_path: Path) -> None:
    found, verdict = judged(look_at(finished.views(tmp_path)))
    assert verdict.word == "but" and verdict.exit_code == 0
    assert found["sharpness"].photos == (f"{finished.CAMERAS[1].name}.jpg",)
    assert (
        found["photos"].photos == ("<b>bad.jpg",) and "the JPEG ends early" in found["photos"].text
    )
    assert "5 of 6 photos" in found["placement"].text
    assert found["placement"].photos == (f"{finished.CAMERAS[5].name}.jpg",)
    assert "a gap of 90 degrees" in found["coverage"].text
    assert found["size"].state == "note"
    assert any("blurred photos again" in text for text in verdict.to_do)


def test_a_try_that_failed_promises_nothing_and_forbids_nothing(tmp_path: Path) -> None:
    found, verdict = judged(look_at(finished.views(tmp_path), trusted=False))
    assert (verdict.word, verdict.exit_code) == ("unclear", 66)
    assert "`run` tries harder" in verdict.line and "cannot be used" not in verdict.line
    assert found["placement"].state == "bad" and verdict.to_do[0] == "Take more"


def test_photos_that_were_not_read_cannot_be_used() -> None:
    found, verdict = judged(Look(Path(), 2, None, refused="found 2 usable photos"))
    assert (verdict.word, verdict.exit_code) == ("no", 65)
    assert found["photos"].text == "found 2 usable photos"


def test_a_turntable_and_copies_are_said(tmp_path: Path) -> None:
    views = finished.views(tmp_path)
    views = replace(views, skipped=(Skipped("b.jpg", "copy of a.jpg", copy_of="a.jpg"),))
    note = "the background stands still while the object turns, as on a turntable"
    found, _ = judged(look_at(views, Placement(None, notes=(note,))))
    assert found["background"].text == note and found["background"].state == "but"
    assert found["copies"].text == "1 photo counted once: b.jpg is a copy of a.jpg"
    assert found["photos"].state == "ok"


def test_dark_and_clipped_photos_are_told_apart(tmp_path: Path) -> None:
    views = finished.views(tmp_path)
    for item, level in ((views.items[0], 10), (views.items[1], 255)):
        write_png(views.image_path(item), np.full((48, 48, 3), level, np.uint8))
    exposures = exposures_of(views)
    assert [one.is_dark for one in exposures.values()] == [True] + 5 * [False]
    assert exposures[views.items[1].name].clipped == 1.0
    lit = [
        replace(v, exif=Exif(exposure_s=1 / (60 if i else 15))) for i, v in enumerate(views.items)
    ]
    findings = findings_of(look_at(replace(views, items=tuple(lit))))
    texts = [finding.text for finding in findings if finding.name == "exposure"]
    assert "too dark" in texts[0] and finished.EVIL in texts[0]
    assert "clipped" in texts[1]
    assert texts[2].endswith("by up to 2.0 stops")


def test_directions_are_in_the_frame_of_the_asset() -> None:
    model = finished.model()
    found = around(model)
    assert found is not None and len(found.directions) == 5
    for camera, direction in zip(model.cameras, found.directions, strict=True):
        x, y, z = camera.center - model.ball.center
        assert direction.height == pytest.approx(
            np.degrees(np.arcsin(z / np.hypot(np.hypot(x, y), z)))
        )
        assert direction.azimuth == pytest.approx(np.degrees(np.arctan2(x, -y)))
    start, end = found.widest
    turns = [d.azimuth for d in found.directions]
    assert start in turns and any(np.isclose((end - t) % 360, 0) for t in turns)
    assert not any(0 < (t - start) % 360 < found.gap_deg - 1e-9 for t in turns)
    assert found.gap_deg > 72  # five of six on a round: one gap is wider than a fifth


def test_a_larger_job_takes_longer(tmp_path: Path) -> None:
    from refdgs_pipe import recipe
    from refdgs_pipe.pipeline.catalog import load_stages

    models = {stage.name: stage.params for stage in load_stages()}
    look = look_at(finished.views(tmp_path))
    seconds = {
        name: cost(look, name, "", recipe.resolve(recipe.load(name), [], models), cores=1).seconds
        for name in ("preview", "matte", "glossy", "paper-real")
    }
    assert list(seconds) == sorted(seconds, key=lambda name: seconds[name])
    settings = recipe.resolve(recipe.load("glossy"), [], models)
    two = cost(look, "glossy", "", settings, cores=2)
    assert 0.5 < two.seconds / seconds["glossy"] < 0.55 and two.bytes > 150e6


def test_a_run_says_before_training_what_the_capture_lacks(tmp_path: Path) -> None:
    lines = early_lines(finished.views(tmp_path), finished.half_placed(), finished.model())
    assert lines[0].startswith("5 of 6 photos have a trusted place; the widest stretch")
    assert lines[1:] == ["the background stands still while the object turns"]
