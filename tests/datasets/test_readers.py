"""Data sets with known poses become the same artifacts, and their world frame stays."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import SHARED, Stages, disc, needs_shared, picture
from PIL import Image
from scenes import orbit

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.camera import Camera
from refdgs_pipe.datasets.readers import read_capture
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.files.colmap import ColmapCamera, ColmapImage, ColmapModel, write_model
from refdgs_pipe.imaging.masks import with_masks

SIZE, FOCAL = 64, 80.0


@pytest.fixture
def stages(tmp_path: Path) -> Stages:
    return Stages(tmp_path / "workspace")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "capture"


def rig(count: int = 6) -> list[Camera]:
    return orbit(count, size=SIZE, focal=FOCAL)


def opengl(camera: Camera) -> np.ndarray:
    return np.asarray(camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0]))


def write_images(folder: Path, count: int, *, alpha: bool = False) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        rgb = picture(i, SIZE, SIZE)
        image = np.dstack([rgb, disc(SIZE, SIZE)]) if alpha else rgb
        Image.fromarray(image).save(folder / f"r_{i}.png")


def write_blender(root: Path) -> None:
    for split in ("train", "test"):
        write_images(root / split, 6, alpha=True)
        Image.fromarray(picture()).save(root / split / "r_0_normal.png")
        frames = [
            {"file_path": f"./{split}/r_{i}", "transform_matrix": opengl(camera).tolist()}
            for i, camera in enumerate(rig())
        ]
        angle = 2 * math.atan(SIZE / 2 / FOCAL)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (root / f"transforms_{split}.json").write_text(text)


def write_nerfstudio(root: Path, **more: Any) -> None:
    write_images(root / "images", 6)
    frames = [
        {"file_path": f"images/r_{i}.png", "transform_matrix": opengl(camera).tolist()}
        for i, camera in enumerate(rig())
    ]
    record = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 32, "cy": 31, "w": SIZE, "h": SIZE}
    (root / "transforms.json").write_text(json.dumps({**record, "frames": frames, **more}))


def test_blender_gives_both_splits_their_poses_and_a_removed_background(
    stages: Stages, root: Path
) -> None:
    write_blender(root)
    views = stages.ingest(root)
    assert [view.name for view in views.items][:2] == ["train_r_0", "train_r_1"]
    assert {view.split for view in views.items} == {"train", "test"}
    assert (views.background, len(views.items)) == ("removed", 12)
    model = stages.sfm(views)
    by_name = {camera.name: camera for camera in model.cameras}
    for i, camera in enumerate(rig()):
        found = by_name[f"test_r_{i}"]
        assert found.split == "test"
        np.testing.assert_allclose(found.cam_from_world, camera.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(found.K, camera.K, atol=1e-9)
    np.testing.assert_array_equal(model.sfm_from_world, np.eye(4))
    np.testing.assert_array_equal(model.up, [0, 0, 1])


def test_blender_lists_only_the_files_it_names_and_their_truth(root: Path) -> None:
    write_blender(root)
    for stem in ("r_0_albedo", "r_0_noise"):
        (root / "test" / f"{stem}.png").write_bytes(b"")
    names = [name for name, _ in Capture((root,)).files()]
    assert "train/r_0.png" in names and "transforms_test.json" in names
    truth = [name for name in names if "normal" in name or "albedo" in name]
    assert truth == ["test/r_0_albedo.png", "test/r_0_normal.png", "train/r_0_normal.png"]
    assert len(names) == 14 + len(truth)


def test_known_lenses_are_scaled_with_their_photos(stages: Stages, root: Path) -> None:
    write_nerfstudio(root)
    for path in (root / "images").iterdir():
        Image.open(path).resize((4 * SIZE, 4 * SIZE)).save(path)
    view = stages.ingest(root, max_side=2 * SIZE).items[0]
    assert view.known is not None and view.width == 2 * SIZE
    np.testing.assert_allclose(view.known.lens.K, [[160, 0, 64], [0, 160, 62], [0, 0, 1]])


def test_a_photo_named_in_the_json_but_missing_is_skipped(stages: Stages, root: Path) -> None:
    write_blender(root)
    (root / "train" / "r_3.png").unlink()
    views = stages.ingest(root)
    assert len(views.items) == 11
    assert "not there" in views.skipped[0].reason and "r_3" in stages.warnings[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"frames": []}', "camera_angle_x is None"),
        ("{", "not readable as JSON"),
        ("[]", "expected an object"),
        ('{"camera_angle_x": 0.7}', "no list `frames`"),
    ],
)
def test_a_damaged_json_says_what_is_wrong(
    stages: Stages, root: Path, text: str, message: str
) -> None:
    write_blender(root)
    (root / "transforms_test.json").write_text(text)
    with pytest.raises(InputError, match=message):
        stages.ingest(root)


def test_nerfstudio_gives_lens_and_poses(stages: Stages, root: Path) -> None:
    write_nerfstudio(root, k1=0.05, p2=0.001)
    views = stages.ingest(root)
    model = stages.sfm(views)
    for i, camera in enumerate(rig()):
        np.testing.assert_allclose(
            model.cameras[i].cam_from_world, camera.cam_from_world, atol=1e-9
        )
        assert model.cameras[i].K[1, 2] == 31
    lens = model.lenses["images_r_0"]
    np.testing.assert_array_equal(lens.distortion, [0.05, 0, 0, 0.001, 0, 0, 0, 0])
    photo = load_photo(views, model, model.cameras[0], scale=0.5)
    assert photo.rgb.shape == (32, 32, 3) and photo.camera.K[0, 0] == FOCAL / 2


def test_what_nerfstudio_applied_is_undone(stages: Stages, root: Path) -> None:
    applied = np.array([[0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2.0]])
    whole = np.vstack([applied, [0, 0, 0, 1]])
    write_nerfstudio(root, applied_transform=applied.tolist())
    record = json.loads((root / "transforms.json").read_text())
    for frame in record["frames"]:
        frame["transform_matrix"] = (whole @ np.array(frame["transform_matrix"])).tolist()
    (root / "transforms.json").write_text(json.dumps(record))
    model = stages.sfm(stages.ingest(root))
    for found, camera in zip(model.cameras, rig(), strict=True):
        np.testing.assert_allclose(found.cam_from_world, camera.cam_from_world, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE is not supported"),
        ({"fl_x": "wide"}, "needs fl_x or camera_angle_x"),
        ({"applied_transform": [[0, 0, 0, 0]] * 3}, "not an invertible"),
    ],
)
def test_a_lens_or_transform_that_cannot_be_used_says_so(
    stages: Stages, root: Path, more: dict[str, Any], message: str
) -> None:
    write_nerfstudio(root, **more)
    with pytest.raises(InputError, match=message):
        stages.ingest(root)


def test_a_mirrored_pose_is_refused(stages: Stages, root: Path) -> None:
    write_nerfstudio(root)
    record = json.loads((root / "transforms.json").read_text())
    mirrored = np.array(record["frames"][0]["transform_matrix"]) @ np.diag([-1, 1, 1, 1])
    record["frames"][0]["transform_matrix"] = mirrored.tolist()
    (root / "transforms.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="mirrored"):
        stages.ingest(root)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("below", ["sparse/0", "sparse"])
def test_a_colmap_workspace_keeps_poses_points_and_tracks(
    stages: Stages, root: Path, text: bool, below: str
) -> None:
    write_images(root / "images", 7)
    lens = ColmapCamera("SIMPLE_RADIAL", 2 * SIZE, 2 * SIZE, np.array([160, 64, 64, 0.01]))
    images = {
        i + 1: ColmapImage(
            quaternion(camera), camera.cam_from_world[:3, 3], 1, f"r_{i}.png",
            np.zeros((2, 2)), np.array([7, -1]),
        )
        for i, camera in enumerate(rig())
    }  # fmt: skip
    points = (np.array([7]), np.array([[0.1, 0.2, 0.3]]), np.array([[1, 2, 3]], np.uint8))
    write_model(root / below, ColmapModel({1: lens}, images, *points, np.ones(1)), text=text)
    views = stages.ingest(root)
    assert len(views.items) == 6 and "no pose" in views.skipped[0].reason
    model = stages.sfm(views)
    for found, camera in zip(model.cameras, rig(), strict=True):
        np.testing.assert_allclose(found.cam_from_world, camera.cam_from_world, atol=1e-9)
        assert found.K[0, 0] == 80  # the photos are half as large as COLMAP saw them
        np.testing.assert_array_equal(model.tracks[found.name], [0])
    np.testing.assert_allclose(model.points, points[1])


def test_a_damaged_colmap_model_says_so(stages: Stages, root: Path) -> None:
    write_images(root / "images", 3)
    (root / "sparse").mkdir()
    for name in ("cameras", "images", "points3D"):
        (root / "sparse" / f"{name}.bin").write_bytes(b"abc")
    with pytest.raises(CorruptError, match="damaged COLMAP model"):
        stages.ingest(root)


@pytest.mark.parametrize("place", ["masks", "images/masks"])
def test_masks_are_found_and_are_no_photos(root: Path, place: str) -> None:
    write_images(root / "images", 3)
    write_images(root / place, 3)
    layout = Capture((root,)).layout()
    assert [path.parent.name for path in layout.photos] == ["images"] * 3
    assert layout.masks == (root / place,)


def test_masks_of_a_sub_folder_are_not_those_of_the_photos_above(root: Path) -> None:
    write_images(root, 3)
    write_images(root / "images" / "masks", 3)
    layout = Capture((root,)).layout()
    assert len(layout.photos) == 3
    frames, strays = with_masks(read_capture(layout).frames, layout.masks, layout.root)
    assert [frame.mask for frame in frames] == [None] * 3 and len(strays) == 3


def test_a_folder_among_files_is_refused(root: Path) -> None:
    write_images(root, 3)
    with pytest.raises(CaptureError, match="is a folder among files"):
        Capture((root, root / "r_0.png")).layout()


def quaternion(camera: Camera) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(camera.cam_from_world[:3, :3])
    return np.asarray(rotation.as_quat(scalar_first=True))


@needs_shared
@pytest.mark.parametrize("scene", ["mug"])
def test_the_ball_of_a_real_scene_holds_the_object_and_little_more(
    stages: Stages, scene: str
) -> None:
    trimesh = pytest.importorskip("trimesh")
    model = stages.sfm(stages.ingest(SHARED / "scenes" / scene))
    mesh = trimesh.load(SHARED / "scenes" / scene / "gt_mesh.ply", process=False)
    reach = np.linalg.norm(np.asarray(mesh.vertices) - model.ball.center, axis=1).max()
    assert reach <= model.ball.radius <= 1.15 * reach
