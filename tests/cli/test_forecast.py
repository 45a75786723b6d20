"""How long a run takes is told from its photos, its settings, and what stages took before."""

from pathlib import Path

import finished
import pytest

from refdgs_pipe import recipe
from refdgs_pipe.checking import cost
from refdgs_pipe.checking.cost import Capture, seconds_of, works
from refdgs_pipe.cli import forecast as module
from refdgs_pipe.cli.forecast import REPORT, forecast
from refdgs_pipe.cli.workspace import Memory, Workspace, open_workspace
from refdgs_pipe.pipeline.catalog import STAGES, load_stages
from refdgs_pipe.pipeline.plan import Step


@pytest.fixture
def space(tmp_path: Path) -> Workspace:
    photos = tmp_path / "ball"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"\xff\xd8")
    return open_workspace(tmp_path / "ball.refdgs", Memory((photos,), "glossy", ()))


def made(space: Workspace, until: str) -> list[Step]:
    """Results of the first stages, as the last run left them."""
    steps = finished.steps(space.pipeline.store, until=until)
    for step in steps:
        if step.origin is not None:
            space.pipeline.store.use(step.origin)
    return steps


def test_nothing_is_told_before_the_photos_are_read(space: Workspace) -> None:
    assert forecast(space, [], STAGES, cores=2) is None


def test_every_stage_and_the_report_are_in_the_whole(space: Workspace) -> None:
    steps = made(space, "ingest")
    found = forecast(space, steps, STAGES[1:], cores=1)
    assert found is not None
    assert list(found.modelled) == [*STAGES[1:], REPORT]
    assert all(seconds > 0 for seconds in found.modelled.values())
    assert found.room is not None and found.room > cost.FIXED_BYTES / 2


def test_two_cores_take_about_half_as_long(space: Workspace) -> None:
    steps = made(space, "ingest")
    one, two = (forecast(space, steps, STAGES[1:], cores=cores) for cores in (1, 2))
    assert one is not None and two is not None
    assert two.modelled["bake"] == pytest.approx(seconds_of(one.modelled["bake"], 2))


def work(name: str, size: Capture, *changes: str) -> dict[str, float]:
    """What the stages of a recipe take, core-seconds."""
    models = {stage.name: stage.params for stage in load_stages()}
    return works(size, recipe.resolve(recipe.load(name), changes, models))


def with_masks() -> Capture:
    return Capture(30, 12.0, 0.75, is_known=False, has_masks=True)


def test_fine_detail_takes_longer_the_more_photos_there_are() -> None:
    """The textures of the recipe detail are larger, and every photo is looked at again."""

    def bake(name: str, photos: int) -> float:
        return work(name, Capture(photos, 12.0, 0.75, is_known=False, has_masks=False))["bake"]

    looked = bake("glossy", 60) - bake("glossy", 20)
    assert looked == pytest.approx(40 * cost.LOOK_S)
    assert bake("detail", 60) - bake("detail", 20) == pytest.approx(
        2 * (bake("detail", 40) - bake("detail", 20))
    )
    assert bake("detail", 60) - bake("detail", 20) > 5 * looked
    assert bake("detail", 20) > bake("glossy", 20)


def test_a_first_shape_takes_longer_with_more_steps_of_the_volume() -> None:
    preview, glossy = (work(name, with_masks())["start"] for name in ("preview", "glossy"))
    assert glossy == pytest.approx(1200 * cost.VOLUME_S) and glossy == pytest.approx(2 * preview)


def test_the_trial_of_near_field_features_takes_its_time() -> None:
    def train(*changes: str) -> float:
        return work("preview", with_masks(), *changes)["train"]

    trial = train() - train("train.local_trial_steps=0")
    assert trial == pytest.approx(2 * 1200 * cost.TRIAL_S)
    assert train("train.local=none") == train("train.iterations=1000") * 2
    assert train("train.reflection=false") == pytest.approx(cost.PLAIN * (train() - trial))


def test_a_first_mesh_takes_its_time_only_if_training_goes_on_from_it() -> None:
    glossy, preview, matte = (work(name, with_masks()) for name in ("glossy", "preview", "matte"))
    mesh = glossy["extract"] + glossy["clean"] + glossy["fit"]
    assert glossy["shape"] == matte["shape"] == pytest.approx(mesh)
    assert "shape" not in preview


def test_without_reflections_there_are_no_materials_to_find() -> None:
    assert work("glossy", with_masks())["appearance"] > 0
    assert "appearance" not in work("matte", with_masks())


def test_an_idle_machine_is_not_called_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "getloadavg", lambda: (0.2, 0.2, 0.2))
    assert module._busy() == 1.0
    monkeypatch.setattr(module, "core_count", lambda: 2)
    monkeypatch.setattr(module.os, "getloadavg", lambda: (8.0, 0.2, 0.2))
    assert module._busy() == 4.0


def test_photos_with_masks_and_places_need_neither_stage(space: Workspace) -> None:
    whole = works(Capture(30, 0.3, 0.75, is_known=False, has_masks=False), space.settings)
    less = works(Capture(30, 0.3, 0.75, is_known=True, has_masks=True), space.settings)
    assert {"sfm", "masks"} <= whole.keys() and not {"sfm", "masks"} & less.keys()
