"""The report's section on placement shows why photos have no place, above all after a refusal."""

import re
from pathlib import Path

import finished
import numpy as np
import pytest

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.reporting.facts import Drawing, Facts, collect
from refdgs_pipe.reporting.page import page
from refdgs_pipe.reporting.placement import draw_overlay, lost_photos

LOST = "speaks against the place"


def body_of(text: str, name: str) -> str:
    return text.partition(f'<section id="{name}">')[2].partition("</section>")[0]


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    """A workspace whose gate said no."""
    store = Store(tmp_path_factory.mktemp("work") / "ball.refdgs")
    told = "only 3 of 6 photos found a place"
    finished.log(
        store,
        {"event": "started", "stage": "gate"},
        {"event": "failed", "kind": "PoseError", "message": told},
    )
    steps = finished.steps(store, until="sfm", placement=finished.half_placed())
    about = {"recipe": "glossy", "changed": (), "settings": {"gate": {"min_trusted": 0.7}}}
    return collect(store, steps, about=about)


def test_a_refused_run_shows_what_was_tried_and_which_checks_failed(refused: Facts) -> None:
    problems: list[str] = []
    text = page(refused, Drawing(), problems)
    assert problems == []
    section = body_of(text, "placement")
    assert "The places are not trusted." in section and "3 of 6 photos" in section
    assert "features as &lt;set&gt;" in section
    assert '<b class="bad">no</b>' in section and "Take more photos" in section
    assert "the background stands still" in section
    assert section.count("<img") == 3


def test_the_contact_sheet_of_a_refused_run_names_every_lost_photo(refused: Facts) -> None:
    sheet = body_of(page(refused, Drawing(), []), "photos")
    assert len(re.findall(r'<figure class="photo lost', sheet)) == 3
    assert sheet.count(LOST) == 2
    assert "at least 15 are needed" in sheet


def test_reasons_come_from_the_gate_where_it_passed(tmp_path: Path) -> None:
    store = Store(tmp_path / "ball.refdgs")
    steps = finished.steps(store, until="gate", placement=finished.half_placed())
    facts = collect(store, steps, about={"recipe": "glossy", "changed": (), "settings": {}})
    assert lost_photos(facts) == {finished.CAMERAS[5].name: "only 3 <matches>"}


def test_an_overlay_colours_points_by_the_ball_and_rings_it(tmp_path: Path) -> None:
    views, model = finished.views(tmp_path), finished.model()
    camera = model.cameras[0]
    model.tracks[camera.name] = np.arange(40)
    drawn = draw_overlay(views, model, camera).astype(int)
    plain = np.round(load_photo(views, model, camera).rgb * 0.8 * 255)
    assert drawn.shape == (48, 48, 3)
    at, _ = camera.project(model.points)
    inside = np.linalg.norm(model.points - model.ball.center, axis=1) < model.ball.radius
    assert inside.any() and not inside.all()
    greens = [drawn[int(y), int(x)] for x, y in at[inside] if 0 <= x < 48 and 0 <= y < 48]
    assert np.mean([pixel[1] > pixel[0] for pixel in greens]) > 0.8
    assert (drawn != plain).any(-1).mean() < 0.9
