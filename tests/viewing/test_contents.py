"""The artifacts of a workspace as a view shows them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest
from training.test_unfinished import stopped
from viewing.test_watching import work

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.pipeline.catalog import STAGES
from refdgs_pipe.pipeline.store import Origin, Record, Store
from refdgs_pipe.stage_words import doing
from refdgs_pipe.training.checkpoint import NAME
from refdgs_pipe.viewing.contents import GLB, Contents, summary
from refdgs_pipe.viewing.watching import Watch


def contents(root: Path) -> Contents:
    """Those of a workspace as it is now."""
    found = Contents()
    found.adopt(Watch(root, STAGES).look())
    return found


def made_again(store: Store, stage: str, artifact: Any, **params: object) -> None:
    """Replace a stage's result by another artifact."""
    found = store.current(stage)
    assert found is not None
    origin = replace(found.origin, params=params)
    partial = store.partial(origin)
    artifact.save(partial)
    store.commit(partial, origin, Record(1.0, {}))
    store.use(origin)


def test_a_finished_workspace_has_everything_to_show(tmp_path: Path) -> None:
    work(tmp_path)
    found = contents(tmp_path)
    scene, mesh, asset, field = found.scene(), found.mesh(), found.asset(), found.field()
    assert scene is not None
    assert len(scene.model.cameras) == 5
    assert mesh is not None
    assert mesh[1] == "fit"
    assert asset is not None
    assert asset.glb.startswith(b"glTF")
    assert field is not None
    assert field.about == "result of refine"
    assert found.newest == "asset"
    assert found.troubles == []


def test_an_empty_workspace_has_nothing_to_show_and_no_trouble(tmp_path: Path) -> None:
    found = contents(tmp_path)
    assert [found.scene(), found.views(), found.mesh(), found.asset(), found.field()] == [None] * 5
    assert (found.newest, found.troubles) == ("", [])


@pytest.mark.parametrize(
    ("until", "newest"), [("gate", ""), ("train", "field"), ("extract", "mesh"), ("bake", "mesh")]
)
def test_the_newest_of_the_object_is_told(tmp_path: Path, until: str, newest: str) -> None:
    work(tmp_path, until=until)
    assert contents(tmp_path).newest == newest


def test_photos_are_small_and_without_masks_as_they_are(tmp_path: Path) -> None:
    work(tmp_path, until="masks")
    found = contents(tmp_path)
    scene = found.scene()
    assert scene is not None
    pixels = found.thumbnail(scene.model.cameras[1], masked=True)
    assert pixels is not None
    from refdgs_pipe.files.images import read_png

    views = found.views()
    assert views is not None
    photo = read_png(views.image_path(views[scene.model.cameras[1].name]))
    np.testing.assert_array_equal(pixels, photo)


def test_a_damaged_piece_is_a_sentence_and_the_rest_is_shown(tmp_path: Path) -> None:
    store = work(tmp_path)
    for stage, name in (("refine", "field.safetensors"), ("fit", "mesh.ply")):
        manifest = store.current(stage)
        assert manifest is not None
        path = store.folder(manifest.origin) / name
        path.write_bytes(b"x" * path.stat().st_size)
    found = contents(tmp_path)
    assert found.field() is None
    assert found.mesh() is None
    assert found.scene() is not None
    assert found.asset() is not None
    assert [text.partition(":")[0] for text in found.troubles] == ["field", "mesh"]
    assert all(text.endswith("It is not shown") for text in found.troubles)


def test_a_damaged_piece_is_read_again_once_it_is_replaced(tmp_path: Path) -> None:
    store = work(tmp_path, until="refine")
    manifest = store.current("refine")
    assert manifest is not None
    path = store.folder(manifest.origin) / "field.json"
    path.write_text(" " * path.stat().st_size)
    found = contents(tmp_path)
    assert found.field() is None
    made_again(store, "refine", finished.field(), turn=1)
    found.adopt(Watch(tmp_path, STAGES).look())
    assert found.field() is not None
    assert found.troubles == []


def test_an_artifact_of_another_version_is_a_sentence(tmp_path: Path) -> None:
    store = work(tmp_path, until="gate")
    other = Appearance(*finished.appearance(np.zeros((3, 3), np.float32)).__dict__.values())
    made_again(store, "gate", other, of="another version")
    found = contents(tmp_path)
    assert found.scene() is None
    assert len(found.troubles) == 1


def test_a_piece_is_the_same_while_nothing_changes(tmp_path: Path) -> None:
    work(tmp_path)
    found = contents(tmp_path)
    field, scene = found.field(), found.scene()
    found.adopt(Watch(tmp_path, STAGES).look())
    assert found.field() is field
    assert found.scene() is scene


def test_a_checkpoint_is_shown_and_stays_until_the_result_of_its_stage_is_seen(
    tmp_path: Path,
) -> None:
    store = work(tmp_path / "work", until="start")
    trainer = stopped(tmp_path / "train", 3)
    scratch = store.scratch(Origin("train", 1, {}, {}))
    (tmp_path / "train" / NAME).rename(scratch / NAME)
    found = contents(tmp_path / "work")
    shown = found.field()
    assert shown is not None
    assert shown.about == "checkpoint of train"
    np.testing.assert_array_equal(shown.field.geometry.means, trainer.frozen().geometry.means)
    (scratch / NAME).unlink()
    assert found.field() is shown
    found.adopt(Watch(tmp_path / "work", STAGES).look())
    assert found.field() is None


def test_the_asset_lies_on_the_mesh_whatever_size_it_was_given(tmp_path: Path) -> None:
    from refdgs_pipe.export.product import product

    store = work(tmp_path)
    mesh = finished.textured(64)
    longest = float(np.ptp(mesh.mesh.vertices, axis=0).max())
    made_again(store, "export", finished.asset(tmp_path), longest=0.1 * longest)
    asset = contents(tmp_path).asset()
    assert asset is not None
    in_metres = product(mesh, up=finished.UP, metres_per_unit=0.1).vertices
    back = in_metres @ asset.world_from_asset.T * asset.scale
    np.testing.assert_allclose(back, mesh.mesh.vertices, atol=1e-5 * longest)
    assert (tmp_path / GLB).is_file()


def test_the_summary_has_a_row_for_each_stage(tmp_path: Path) -> None:
    work(tmp_path, until="gate")
    events = [{"event": "started", "stage": "masks", "time": 1.0}]
    finished.log(Store(tmp_path), *json.loads(json.dumps(events)), name="20260101-000000-1")
    stages = {name: doing(name) for name in STAGES}
    with Store(tmp_path).lock():
        rows = {row[0]: row for row in summary(Watch(tmp_path, STAGES).look(), stages)}
    assert rows["gate"] == ("gate", "done", finished.SECONDS)
    assert rows["masks"] == ("masks", "running: finding the object in the photos", None)
    assert rows["export"] == ("export", "", None)
