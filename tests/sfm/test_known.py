"""Features add points to poses that came with the capture."""

import json
from pathlib import Path

import numpy as np
import pytest
from captures import Stages
from PIL import Image

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.sfm.known import without_points

QUICK = {"max_features": 2500}


def write_capture(
    folder: Path, photos: list[Path], cameras: list[Camera], lenses: list[Lens]
) -> Path:
    """A nerfstudio folder; OpenGL cameras, and a lens for each photo."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for photo, camera, lens in zip(photos, cameras, lenses, strict=True):
        (folder / "images" / photo.name).write_bytes(photo.read_bytes())
        k = dict(zip(("k1", "k2", "p1", "p2"), lens.distortion[:4].tolist(), strict=True))
        frames.append(
            {
                "file_path": f"images/{photo.name}",
                "transform_matrix": (
                    np.linalg.inv(camera.cam_from_world) @ np.diag([1.0, -1, -1, 1])
                ).tolist(),
                "w": camera.width,
                "h": camera.height,
                "fl_x": lens.K[0, 0],
                "fl_y": lens.K[1, 1],
                "cx": lens.K[0, 2],
                "cy": lens.K[1, 2],
                **k,
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def test_photos_with_poses_alone_get_points_where_the_lens_counts(
    placed: tuple[list[Path], SparseModel], tmp_path: Path
) -> None:
    photos, model = placed
    lenses = [model.lenses[camera.name] for camera in model.cameras]
    assert any(lens.distortion.any() for lens in lenses)
    stages = Stages(tmp_path / "w")
    views = stages.ingest(write_capture(tmp_path / "set", photos, list(model.cameras), lenses))
    found = stages.sfm(views, **QUICK)
    assert len(found.points) > 0.7 * len(model.points) > 500
    assert stages.measured["reprojection error"] < 0.8
    assert not stages.warnings
    for one, other in zip(model.cameras, found.cameras, strict=True):
        np.testing.assert_allclose(one.cam_from_world, other.cam_from_world, atol=1e-6)


def test_poses_that_fit_no_feature_are_kept_and_said(
    placed: tuple[list[Path], SparseModel], tmp_path: Path
) -> None:
    _, model = placed
    rng = np.random.default_rng(0)
    photos = [tmp_path / f"{camera.name}.png" for camera in model.cameras]
    for photo in photos:
        noise = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8))
        noise.resize((model.cameras[0].width, model.cameras[0].height)).save(photo)
    lenses = [model.lenses[camera.name] for camera in model.cameras]
    stages = Stages(tmp_path / "w")
    views = stages.ingest(write_capture(tmp_path / "set", photos, list(model.cameras), lenses))
    found = stages.sfm(views, **QUICK)
    assert len(found.cameras) == 12
    assert len(found.points) < 20
    assert any("the poses may be wrong" in text for text in stages.warnings)


def test_a_machine_that_cannot_match_features_keeps_the_poses(
    placed: tuple[list[Path], SparseModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos, model = placed
    lenses = [model.lenses[camera.name] for camera in model.cameras]
    stages = Stages(tmp_path / "w")
    views = stages.ingest(write_capture(tmp_path / "set", photos, list(model.cameras), lenses))

    def missing(*_: object, **__: object) -> Poses:
        raise ModuleNotFoundError("No module named 'pycolmap'")

    monkeypatch.setattr("refdgs_pipe.child_process.call_in_child", missing)
    found = stages.sfm(views)
    assert len(found.cameras) == 12 and not len(found.points)
    assert stages.warnings == [without_points(ImportError("No module named 'pycolmap'"))]
