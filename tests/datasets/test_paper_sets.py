"""The data sets of the paper, rebuilt small in their layouts: what is read, masked and held out."""

import json
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import Stages, disc, picture
from PIL import Image
from scenes import orbit
from scipy.spatial.transform import Rotation

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.datasets.splits import NERO_TEST
from refdgs_pipe.errors import CaptureError, CorruptError, InputError, RefdgsError
from refdgs_pipe.files.colmap import ColmapCamera, ColmapImage, ColmapModel, write_model
from refdgs_pipe.files.images import read_png, write_png

SIZE, FOCAL = 48, 60.0
MASK = disc(SIZE, SIZE)


@pytest.fixture
def stages(tmp_path: Path) -> Stages:
    return Stages(tmp_path / "workspace")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "scene"


def rig(count: int) -> list[Camera]:
    return orbit(count, size=SIZE, focal=FOCAL)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def opengl(camera: Camera) -> list[list[float]]:
    matrix: list[list[float]] = (camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
    return matrix


def write_json(path: Path, lens: dict[str, Any], files: list[str], cameras: list[Camera]) -> None:
    frames = [
        {"file_path": file, "transform_matrix": opengl(camera)}
        for file, camera in zip(files, cameras, strict=True)
    ]
    path.write_text(json.dumps({**lens, "frames": frames}))


def write_shiny(root: Path, *, ball: bool, matte: int = 255, count: int = 4) -> None:
    """Shiny Blender: RGBA, or for `ball` RGB over `matte` with the alpha in r_0_alpha.png."""
    alpha = (MASK // 255 * 255).astype(np.uint8)
    alpha[MASK.shape[0] // 2, : SIZE // 3] = 128  # some soft pixels
    for split in ("train", "test"):
        for i in range(count):
            rgb = picture(i, SIZE, SIZE)
            if ball:
                share = alpha[..., None] / 255
                over = np.round(rgb * share + matte * (1 - share)).astype(np.uint8)
                save(root / split / f"r_{i}.png", over)
                save(root / split / f"r_{i}_alpha.png", alpha)
            else:
                save(root / split / f"r_{i}.png", np.dstack([rgb, alpha]))
            save(root / split / f"r_{i}_normal.png", picture(9, SIZE, SIZE))
        lens = {"camera_angle_x": 2 * math.atan(SIZE / 2 / FOCAL)}
        files = [f"./{split}/r_{i}" for i in range(count)]
        write_json(root / f"transforms_{split}.json", lens, files, rig(count))


def write_nero(root: Path, numbers: list[int], **changed: bytes) -> None:
    """GlossySynthetic as NeRO published it; `changed` are other bytes for a numbered camera."""
    root.mkdir(parents=True)
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    for number, camera in zip(numbers, rig(len(numbers)), strict=True):
        save(root / f"{number}.png", picture(number, SIZE, SIZE))
        depth = np.where(MASK > 0, 4.0, 15.0) / 15 * 65535
        write_png(root / f"{number}-depth.png", depth.round().astype(np.uint16))
        data = pickle.dumps((camera.cam_from_world[:3], K))
        data = changed.get(f"camera{number}", data)
        (root / f"{number}-camera.pkl").write_bytes(data)
    (root / "eval_pts.ply").write_bytes(b"ply\n")


def write_converted(root: Path, count: int, *, one_json: bool) -> None:
    """GlossySynthetic as converted: rgb/0.png RGBA, fl_x, no camera_angle_x, points.ply."""
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2, "w": SIZE, "h": SIZE}
    for i in range(count):
        save(root / "rgb" / f"{i}.png", np.dstack([picture(i, SIZE, SIZE), MASK]))
    (root / "points.ply").write_bytes(b"ply\n")
    cameras = rig(count)
    if one_json:
        files = [f"rgb/{i}.png" for i in range(count)]
        write_json(root / "transforms.json", lens, files, cameras)
        return
    for split in ("train", "test"):
        mine = [i for i in range(count) if (i in NERO_TEST) == (split == "test")]
        files = [f"rgb/{i}.png" for i in mine]
        write_json(root / f"transforms_{split}.json", lens, files, [cameras[i] for i in mine])


def write_colmap(
    root: Path, count: int, *, model: str = "sparse/0", images: str = "images", **pose: Any
) -> None:
    """Ref-Real and GlossyReal; `pose` changes the first image's."""
    lens = ColmapCamera("SIMPLE_RADIAL", SIZE, SIZE, np.array([FOCAL, SIZE / 2, SIZE / 2, 0.01]))
    poses = {}
    for i, camera in enumerate(rig(count)):
        save(root / images / f"DSC{i:03d}.png", picture(i, SIZE, SIZE))
        matrix = camera.cam_from_world
        quat = Rotation.from_matrix(matrix[:3, :3]).as_quat(scalar_first=True)
        chosen = {"quat": quat, "translation": matrix[:3, 3]} | (pose if i == 0 else {})
        seen = {"keypoints": np.zeros((2, 2)), "point_ids": np.array([5, 6])}
        poses[i + 1] = ColmapImage(camera_id=1, name=f"DSC{i:03d}.png", **chosen, **seen)
    xyz = np.array([[0.1, 0.2, 0.3], [np.nan, 0, 0]])
    points = (np.array([5, 6]), xyz, np.zeros((2, 3), np.uint8), np.ones(2))
    write_model(root / model, ColmapModel({1: lens}, poses, *points))


def held_out(views: Views) -> list[str]:
    return [view.source for view in views.items if view.split == "test"]


def mask_of(views: Views, index: int = 0) -> np.ndarray:
    path = views.mask_path(views.items[index])
    assert path is not None
    return read_png(path)


def check_poses(stages: Stages, views: Views, cameras: list[Camera]) -> None:
    """The sparse model has the rig's cameras, in the order of the views."""
    model = stages.sfm(views)
    found = {camera.name: camera for camera in model.cameras}
    for view, camera in zip(views.items, cameras, strict=True):
        pose = found[view.name].cam_from_world
        np.testing.assert_allclose(pose, camera.cam_from_world, atol=1e-9)
        assert found[view.name].K[0, 0] == pytest.approx(FOCAL)


# Shiny Blender


@pytest.mark.parametrize("matte", [255, 0])
def test_an_alpha_in_a_file_of_its_own_is_a_mask_and_its_matte_is_removed(
    stages: Stages, root: Path, matte: int
) -> None:
    write_shiny(root, ball=True, matte=matte)
    views = stages.ingest(root)
    assert (len(views.items), views.background) == (8, "removed")
    mask, rgb = mask_of(views), read_png(views.image_path(views.items[0]))
    assert set(np.unique(mask)) == {0, 128, 255}
    error = np.abs(rgb.astype(int) - picture(0, SIZE, SIZE))
    assert error[mask > 0].max() <= 2  # 8 bits over a half-covered pixel
    assert stages.warnings == []


def test_a_matte_that_is_not_plain_is_left_as_it_is(stages: Stages, root: Path) -> None:
    write_shiny(root, ball=True)
    straight = picture(0, SIZE, SIZE)
    save(root / "train" / "r_0.png", straight)
    views = stages.ingest(root)
    np.testing.assert_array_equal(read_png(views.image_path(views.items[0])), straight)


def test_the_alpha_of_the_photo_comes_before_a_file_that_repeats_it(
    stages: Stages, root: Path
) -> None:
    write_shiny(root, ball=False)
    for i in range(4):
        save(root / "train" / f"r_{i}_alpha.png", 255 - MASK)
    views = stages.ingest(root)
    assert views.background == "removed"
    assert mask_of(views)[SIZE // 2, SIZE // 2] == 255
    np.testing.assert_array_equal(
        read_png(views.image_path(views.items[0])), picture(0, SIZE, SIZE)
    )


@pytest.mark.parametrize("ball", [True, False])
def test_normal_and_alpha_maps_are_no_photos(stages: Stages, root: Path, ball: bool) -> None:
    write_shiny(root, ball=ball)
    views = stages.ingest(root)
    assert not any("normal" in view.source or "alpha" in view.source for view in views.items)
    assert held_out(views) == [f"test/r_{i}.png" for i in range(4)]
    names = {name for name, _ in Capture((root,)).files()}
    assert ("train/r_0_alpha.png" in names) == ball  # what is read is fingerprinted
    check_poses(stages, views, [*rig(4), *rig(4)])


def test_a_damaged_alpha_file_skips_its_photo(stages: Stages, root: Path) -> None:
    write_shiny(root, ball=True)
    (root / "train" / "r_1_alpha.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    save(root / "train" / "r_2_alpha.png", np.zeros((SIZE, SIZE), np.uint8))
    views = stages.ingest(root)
    reasons = {skipped.name: skipped.reason for skipped in views.skipped}
    assert "r_1_alpha.png" in reasons["train/r_1.png"]
    assert "r_2_alpha.png is all black" in reasons["train/r_2.png"]


# GlossySynthetic as published


def test_glossy_synthetic_gives_poses_masks_by_depth_and_neros_split(
    stages: Stages, root: Path
) -> None:
    write_nero(root, list(range(16)))
    views = stages.ingest(root)
    assert [view.source for view in views.items] == [f"{i}.png" for i in range(16)]
    assert held_out(views) == [f"{i}.png" for i in (0, 2, 3, 4, 5, 7, 11, 14)]
    assert views.background == "removed"
    np.testing.assert_array_equal(mask_of(views), MASK)
    check_poses(stages, views, rig(16))
    names = {name for name, _ in Capture((root,)).files()}
    assert {"3.png", "3-camera.pkl", "3-depth.png"} <= names
    assert stages.warnings == []


def test_neros_split_has_32_of_128_views() -> None:
    assert len(NERO_TEST) == 32 and max(NERO_TEST) == 127


def test_the_depth_of_14_5_is_where_the_background_begins(stages: Stages, root: Path) -> None:
    write_nero(root, [0, 1, 2])
    levels = np.full((SIZE, SIZE), 65535, np.uint16)
    levels[:, : SIZE // 2] = int(14.5 / 15 * 65535)  # just below 14.5
    levels[0] = int(14.5 / 15 * 65535) + 1
    write_png(root / "0-depth.png", levels)
    expected = np.where(levels == levels[-1, 0], 255, 0)
    np.testing.assert_array_equal(mask_of(stages.ingest(root)), expected)


def test_every_eighth_is_a_setting(stages: Stages, root: Path) -> None:
    write_nero(root, list(range(20)))
    assert held_out(stages.ingest(root, split="every8")) == ["0.png", "8.png", "16.png"]


@pytest.mark.parametrize(
    ("numbers", "split", "tests", "says"),
    [
        ([126, 127, 128, 200], "auto", [127], ""),
        ([126, 127, 128, 200], "nero", [127], ""),
        ([6, 8, 9, 10, 12], "auto", [8], "none of the 5 photos are test views"),
        ([0, 2, 3, 8], "every8", [0, 8], ""),
        ([0, 2, 3, 4, 5], "auto", [0], "all of the 5 photos are test views"),
        ([129, 130, 131], "auto", [129], "none of the 3"),
        ([8, 16, 24], "every8", [16], ""),  # all are multiples: the first by name
    ],
)
def test_a_split_that_does_not_fit_falls_back_and_says_so(
    stages: Stages, root: Path, numbers: list[int], split: str, tests: list[int], says: str
) -> None:
    write_nero(root, numbers)
    assert held_out(stages.ingest(root, split=split)) == [f"{i}.png" for i in tests]
    assert (says in " ".join(stages.warnings)) if says else stages.warnings == []


def test_neros_split_needs_numbers(stages: Stages, root: Path) -> None:
    write_shiny(root, ball=False)
    with pytest.raises(InputError, match=r"not called 0\.png"):
        stages.ingest(root, split="nero")


def test_what_is_missing_in_glossy_synthetic_is_skipped_and_said(
    stages: Stages, root: Path
) -> None:
    write_nero(root, list(range(9)))
    (root / "1.png").unlink()
    (root / "4-camera.pkl").unlink()
    (root / "6-depth.png").unlink()
    save(root / "7.png", picture(7, SIZE, SIZE // 2))
    save(root / "8-depth.png", MASK)
    views = stages.ingest(root)
    reasons = {skipped.name: skipped.reason for skipped in views.skipped}
    assert "1-camera.pkl is there, but not the photo" in reasons["1.png"]
    assert "4-camera.pkl is not there" in reasons["4.png"]
    assert "6-depth.png is not there" in reasons["6.png"]
    assert "is 24 x 48 but most others are 48 x 48" in reasons["7.png"]
    assert "8-depth.png: expected a 16-bit PNG" in reasons["8.png"]
    assert len(views.items) == 4 and "5 of 9 files skipped" in stages.warnings[0]


def test_without_any_depth_nothing_is_masked(stages: Stages, root: Path) -> None:
    write_nero(root, [0, 1, 2])
    for path in root.glob("*-depth.png"):
        path.unlink()
    assert stages.ingest(root).background == "photo"


POSE, K = rig(1)[0].cam_from_world[:3], np.array([[FOCAL, 0, 24], [0, FOCAL, 24], [0, 0, 1.0]])


class Touch:
    """Pickles as a call that writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    ("made", "error", "words"),
    [
        ((K, POSE), InputError, r"shapes \[\(3, 3\), \(3, 4\)\], expected \[\(3, 4\), \(3, 3\)\]"),
        ((POSE,), InputError, "expected"),
        ((POSE * np.nan, K), InputError, "holds NaN or infinity"),
        ((POSE + np.inf, K), InputError, "holds NaN or infinity"),
        ((POSE * [[1], [1], [-1]], K), InputError, "mirrored"),
        ((POSE * [[1], [1], [3]], K), InputError, "sheared"),
        ((POSE * 0, K), InputError, "flat"),
        ((POSE, K * np.nan), InputError, "K is"),
        ((POSE, K.T), InputError, "K is"),
        ((POSE, -K), InputError, "K is"),
        ((POSE, K * [[1, 1, 9], [1, 1, 1], [1, 1, 1]]), InputError, "outside the photo"),
        ([POSE, K], CorruptError, "EMPTY_LIST"),
        ((POSE, "K"), CorruptError, "else than arrays"),
    ],
)
def test_a_camera_that_is_none_names_its_file(
    stages: Stages, root: Path, made: Any, error: type[RefdgsError], words: str
) -> None:
    write_nero(root, [0, 1, 2, 3], camera2=pickle.dumps(made))
    with pytest.raises(error, match=words) as caught:
        stages.ingest(root)
    assert "2-camera.pkl" in str(caught.value)


def test_a_camera_that_would_run_something_runs_nothing(
    stages: Stages, root: Path, tmp_path: Path
) -> None:
    canary = tmp_path / "canary"
    data = pickle.dumps((Touch(canary), K))
    write_nero(root, [0, 1, 2], camera1=data)
    with pytest.raises(CorruptError, match="nothing in it was run"):
        stages.ingest(root)
    assert not canary.exists()
    pickle.loads(data)
    assert canary.exists()  # which Python's own reader would have made


# GlossySynthetic as converted


@pytest.mark.parametrize("one_json", [True, False])
def test_converted_glossy_synthetic_needs_no_camera_angle(
    stages: Stages, root: Path, one_json: bool
) -> None:
    write_converted(root, 8, one_json=one_json)
    views = stages.ingest(root)
    assert (len(views.items), views.background) == (8, "removed")
    np.testing.assert_array_equal(mask_of(views), MASK)
    order = [int(Path(view.source).stem) for view in views.items]
    check_poses(stages, views, [rig(8)[i] for i in order])
    expected = [] if one_json else [0, 2, 3, 4, 5, 7]
    assert held_out(views) == [f"rgb/{i}.png" for i in expected]
    assert views.points is None  # points.ply is made from the truth


@pytest.mark.parametrize("one_json", [True, False])
@pytest.mark.parametrize(("split", "tests"), [("nero", [0, 2, 3, 4, 5, 7]), ("every8", [0, 8])])
def test_converted_glossy_synthetic_takes_both_splits(
    stages: Stages, root: Path, one_json: bool, split: str, tests: list[int]
) -> None:
    write_converted(root, 9, one_json=one_json)
    found = held_out(stages.ingest(root, split=split))
    assert sorted(found) == [f"rgb/{i}.png" for i in tests]


# Ref-Real and GlossyReal


@pytest.mark.parametrize(
    ("model", "images"),
    [("sparse/0", "images"), ("colmap/sparse/0", "images"), ("colmap/sparse/0", "colmap/images")],
)
def test_real_sets_hold_out_every_eighth_by_name(
    stages: Stages, root: Path, model: str, images: str
) -> None:
    write_colmap(root, 18, model=model, images=images)
    (root / "object_point_cloud.ply").write_bytes(b"ply\n")
    views = stages.ingest(root)
    assert held_out(views) == ["DSC000.png", "DSC008.png", "DSC016.png"]
    assert views.background == "photo"
    check_poses(stages, views, rig(18))


def test_a_small_real_set_holds_out_only_when_told_so(tmp_path: Path, root: Path) -> None:
    write_colmap(root, 9)
    assert held_out(Stages(tmp_path / "w1").ingest(root)) == []
    told = Stages(tmp_path / "w2").ingest(root, split="every8")
    assert held_out(told) == ["DSC000.png", "DSC008.png"]


def test_points_that_are_nowhere_are_left_out(stages: Stages, root: Path) -> None:
    write_colmap(root, 4)
    model = stages.sfm(stages.ingest(root))
    np.testing.assert_allclose(model.points, [[0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(model.tracks["DSC000"], [0])


# What is wrong with any of them

WRITERS: dict[str, Callable[[Path, int], None]] = {
    "shiny": lambda root, count: write_shiny(root, ball=True, count=count),
    "nero": lambda root, count: write_nero(root, list(range(count))),
    "converted": lambda root, count: write_converted(root, count, one_json=True),
    "real": lambda root, count: write_colmap(root, count),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_one_view_is_too_few_and_a_missing_photo_is_skipped(
    stages: Stages, root: Path, tmp_path: Path, kind: str
) -> None:
    WRITERS[kind](root, 1)
    usable = 2 if kind == "shiny" else 1  # one of each split
    photos = "2 usable photos" if usable == 2 else "1 usable photo"
    with pytest.raises(CaptureError, match=f"found {photos}, at least 3 are needed"):
        stages.ingest(root)
    WRITERS[kind](tmp_path / "four", 4)
    (photo,) = [
        path
        for path in (tmp_path / "four").rglob("*.png")
        if re.fullmatch(r"(train/r_|rgb/|images/DSC00|four/)1.png", "/".join(path.parts[-2:]))
    ]
    photo.unlink()
    other = Stages(tmp_path / "other")
    views = other.ingest(tmp_path / "four")
    assert len(views.items) == (7 if kind == "shiny" else 3)
    assert "1 of " in other.warnings[-1] and "skipped" in other.warnings[-1]


@pytest.mark.parametrize("kind", WRITERS)
def test_a_photo_of_another_shape_is_skipped_and_said(
    stages: Stages, root: Path, kind: str
) -> None:
    WRITERS[kind](root, 5)
    place = {"shiny": "train/r_2", "nero": "2", "converted": "rgb/2", "real": "images/DSC002"}
    photo = root / f"{place[kind]}.png"
    Image.open(photo).crop((0, 0, SIZE, SIZE // 2)).save(photo)
    views = stages.ingest(root)
    (skipped,) = views.skipped
    assert "is 48 x 24 but" in skipped.reason and "48 x 48" in skipped.reason
    assert "their shapes must agree" in stages.warnings[0]


@pytest.mark.parametrize("kind", ["shiny", "converted", "real"])
def test_a_reduced_copy_is_used_with_its_own_lens(stages: Stages, root: Path, kind: str) -> None:
    WRITERS[kind](root, 5)
    place = {"shiny": "train/r_2", "converted": "rgb/2", "real": "images/DSC002"}
    photo = root / f"{place[kind]}.png"
    Image.open(photo).resize((SIZE // 2, SIZE // 2)).save(photo)
    if kind == "shiny":
        alpha = photo.with_name("r_2_alpha.png")
        Image.open(alpha).resize((SIZE // 2, SIZE // 2)).save(alpha)
    views = stages.ingest(root)
    (small,) = [view for view in views.items if view.width == SIZE // 2]
    assert small.known is not None
    assert small.known.lens.K[0, 0] == pytest.approx(FOCAL / 2)
    stages.sfm(views)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("kind", ["shiny", "converted"])
def test_a_pose_in_a_json_that_is_not_finite_names_its_photo(
    stages: Stages, root: Path, kind: str, value: float
) -> None:
    WRITERS[kind](root, 4)
    path = next(root.glob("transforms*.json"))
    record = json.loads(path.read_text())
    record["frames"][2]["transform_matrix"][1][3] = value
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match="holds NaN or infinity") as caught:
        stages.ingest(root)
    assert record["frames"][2]["file_path"] in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("fl_x", math.nan, "finite numbers"),
        ("fl_x", math.inf, "finite numbers"),
        ("fl_x", -60, "finite numbers"),
        ("fl_x", "wide", "needs fl_x"),
        ("cx", math.nan, "finite numbers"),
        ("k1", math.inf, "finite numbers"),
        ("w", "broad", "w and h must be pixels"),
        ("w", math.nan, "finite numbers"),
        ("applied_scale", 0, "not finite, or is 0"),
        ("applied_scale", "x", "must be numbers"),
        ("applied_transform", [[math.nan] * 4] * 3, "not finite"),
        ("applied_transform", [[1, 0, 0, math.inf], [0, 1, 0, 0], [0, 0, 1, 0]], "not finite"),
        ("frames", [1, 2], "no list `frames`"),
        ("frames", {}, "no list `frames`"),
        ("frames", [{"file_path": "rgb/0.png"}], "no 4 x 4 transform_matrix"),
        (
            "frames",
            [{"file_path": "rgb/0.png", "transform_matrix": [["a"] * 4] * 4}],
            "no 4 x 4 transform_matrix",
        ),
    ],
)
def test_a_json_with_odd_values_says_so(
    stages: Stages, root: Path, key: str, value: Any, words: str
) -> None:
    write_converted(root, 4, one_json=True)
    record = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**record, key: value}))
    with pytest.raises(InputError, match=words):
        stages.ingest(root)


@pytest.mark.parametrize(
    "pose",
    [
        {"translation": np.array([0, np.nan, 0])},
        {"quat": np.array([np.inf, 0, 0, 0])},
        {"quat": np.zeros(4)},
    ],
)
def test_a_pose_in_a_colmap_model_that_is_none_names_its_photo(
    stages: Stages, root: Path, pose: dict[str, Any]
) -> None:
    write_colmap(root, 4, **pose)
    with pytest.raises(InputError, match=r"DSC000\.png: the pose holds NaN"):
        stages.ingest(root)
