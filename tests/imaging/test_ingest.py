"""What becomes of photos, masks and RAW files, and of everything that is none of these."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import EXAMPLE, SHARED, Stages, disc, needs_shared, picture, write_photos
from PIL import Image

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Exif, Views
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import read_png
from refdgs_pipe.imaging.masks import are_inverted
from refdgs_pipe.imaging.metadata import read_exif
from refdgs_pipe.imaging.raw import develop, exposure_of, plan_development


@pytest.fixture
def stages(tmp_path: Path) -> Stages:
    return Stages(tmp_path / "workspace")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def test_every_format_gives_the_same_view(stages: Stages, photos: Path) -> None:
    for i, suffix in enumerate(("png", "tif", "webp", "jpg")):
        options = {"quality": 98} if suffix == "jpg" else {}
        options |= {"lossless": True} if suffix == "webp" else {}
        Image.fromarray(picture(i)).save(photos / f"{i}.{suffix}", **options)
    views = stages.ingest(photos)
    assert [view.name for view in views.items] == ["0", "1", "2", "3"]
    assert (views.color_space, views.background) == ("srgb", "photo")
    for view in views.items:
        pixels = read_png(views.image_path(view)).astype(int)
        assert np.abs(pixels - picture(int(view.name))).max() <= (20 if view.name == "3" else 0)
        assert view.known is None and view.mask is None and view.sharpness > 0


def test_the_exif_is_kept(stages: Stages) -> None:
    views = stages.ingest(*sorted(EXAMPLE.glob("*.jpg"))[:3])
    exif = views.items[0].exif
    assert (exif.make, exif.model, exif.focal_mm) == ("RefBench", "SimCam36", 35.0)
    assert exif.focal_fraction == pytest.approx(35 / 36, rel=1e-3)
    assert exif.exposure_s == 0.008 and exif.time is not None


def test_the_focal_length_by_film_counts_where_the_sensor_contradicts_it() -> None:
    assert Exif().focal_fraction is None
    assert Exif(focal_mm=4.0, focal_35mm=28.0).focal_fraction == pytest.approx(28 / 36)
    stale = Exif(focal_mm=4.0, focal_35mm=28.0, sensor_width_mm=40.0)
    assert stale.focal_fraction == pytest.approx(28 / 36)


def test_long_sides_are_limited(stages: Stages, photos: Path) -> None:
    for i, path in enumerate(write_photos(photos)):
        Image.fromarray(picture(i, height=200, width=300)).save(path)
    views = stages.ingest(photos, max_side=100)
    assert {(view.width, view.height) for view in views.items} == {(100, 67)}
    assert read_png(views.image_path(views.items[0])).shape == (67, 100, 3)


def test_structure_from_motion_gets_larger_pictures_than_a_recipe_asks_for(
    stages: Stages, photos: Path
) -> None:
    for i, path in enumerate(write_photos(photos)):
        Image.fromarray(picture(i, height=200 if i else 60, width=300 if i else 90)).save(path)
    views = stages.ingest(photos, max_side=100, placing_side=150)
    small, *large = views.items
    assert small.placing is None and views.placing_path(small) == views.image_path(small)
    for view in large:
        assert (view.width, view.height) == (100, 67)
        placing = read_png(views.placing_path(view))
        assert placing.shape == (100, 150, 3) and placing.dtype == np.uint8
    views.save(photos / "elsewhere")
    assert Views.load(photos / "elsewhere").placing_path(large[0]).is_file()


def test_pictures_for_structure_from_motion_are_only_written_where_needed(
    tmp_path: Path,
) -> None:
    for i, path in enumerate(write_photos(tmp_path / "photos")):
        Image.fromarray(picture(i, height=200, width=300)).save(path)
    for name, settings in (
        ("w1", {"max_side": 150, "placing_side": 150}),
        ("w2", {"max_side": 400, "placing_side": 800}),
    ):
        views = Stages(tmp_path / name).ingest(tmp_path / "photos", **settings)
        assert {view.placing for view in views.items} == {None}
        assert not (views.folder / "placing").exists()


def test_views_written_before_there_were_such_pictures_still_open(
    stages: Stages, photos: Path
) -> None:
    write_photos(photos)
    views = stages.ingest(photos)
    record = json.loads((views.folder / "views.json").read_text())
    for view in record["views"]:
        del view["placing"]
    (views.folder / "views.json").write_text(json.dumps(record))
    assert [view.placing for view in Views.load(views.folder).items] == [None] * 3


def test_a_lying_photo_stands_up_and_its_mask_with_it(stages: Stages, photos: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    for i, path in enumerate(write_photos(photos)):
        Image.fromarray(picture(i)).save(path, exif=exif)
    (photos / "masks").mkdir()
    lying = np.zeros((48, 64), np.uint8)
    lying[10:38, 40:60] = 255
    for i in range(3):
        Image.fromarray(lying).save(photos / "masks" / f"IMG_{i}.png")
    views = stages.ingest(photos)
    assert (views.items[0].width, views.items[0].height) == (48, 64)
    mask_path = views.mask_path(views.items[0])
    assert mask_path is not None
    np.testing.assert_array_equal(read_png(mask_path), np.rot90(lying, -1))


@pytest.mark.parametrize("layout", ["{stem}.png", "{stem}.jpg.png", "{upper}.PNG"])
@pytest.mark.parametrize("inverted", [False, True])
def test_masks_are_found_and_turned_the_right_way(
    stages: Stages, photos: Path, layout: str, inverted: bool
) -> None:
    for path in write_photos(photos):
        name = layout.format(stem=path.stem, upper=path.stem.upper())
        (photos / "masks").mkdir(exist_ok=True)
        Image.fromarray(255 - disc() if inverted else disc()).save(photos / "masks" / name)
    views = stages.ingest(photos)
    assert views.background == "masked"
    for view in views.items:
        mask_path = views.mask_path(view)
        assert mask_path is not None
        np.testing.assert_array_equal(read_png(mask_path), disc())
    assert any("other way round" in text for text in stages.warnings) == inverted


def test_masks_of_zero_and_one_count(stages: Stages, photos: Path) -> None:
    write_photos(photos)
    (photos / "masks").mkdir()
    for i in range(3):
        Image.fromarray(disc() // 255).save(photos / "masks" / f"IMG_{i}.png")
    view_masks = stages.ingest(photos)
    mask_path = view_masks.mask_path(view_masks.items[0])
    assert mask_path is not None and read_png(mask_path).max() == 255


def test_an_object_that_fills_the_middle_is_not_inverted() -> None:
    assert not are_inverted([disc()] * 3)
    assert are_inverted([255 - disc()] * 2 + [disc()])
    assert not are_inverted([])


@pytest.mark.parametrize(("value", "word"), [(0, "all black"), (255, "all white")])
def test_an_empty_mask_is_refused_with_its_reason(
    stages: Stages, photos: Path, value: int, word: str
) -> None:
    write_photos(photos, 4)
    (photos / "masks").mkdir()
    for i in range(4):
        Image.fromarray(disc()).save(photos / "masks" / f"IMG_{i}.png")
    Image.fromarray(np.full((48, 64), value, np.uint8)).save(photos / "masks" / "IMG_2.png")
    views = stages.ingest(photos)
    assert [view.name for view in views.items] == ["IMG_0", "IMG_1", "IMG_3"]
    assert word in views.skipped[0].reason
    assert any(f"masks/IMG_2.png is {word}" in text for text in stages.warnings)


def test_only_empty_masks_are_an_error_that_says_so(stages: Stages, photos: Path) -> None:
    write_photos(photos)
    (photos / "masks").mkdir()
    for i in range(3):
        Image.new("L", (64, 48)).save(photos / "masks" / f"IMG_{i}.png")
    with pytest.raises(CaptureError, match="all black: it marks no object"):
        stages.ingest(photos)


def test_a_mask_of_another_shape_is_refused(stages: Stages, photos: Path) -> None:
    write_photos(photos, 4)
    (photos / "masks").mkdir()
    Image.fromarray(disc(64, 64)).save(photos / "masks" / "IMG_0.png")
    views = stages.ingest(photos)
    assert "64 x 64 but its photo is 64 x 48" in views.skipped[0].reason
    assert any("3 photos have no mask" in text for text in stages.warnings) is False


def test_an_alpha_channel_is_a_soft_mask_of_a_removed_background(
    stages: Stages, photos: Path
) -> None:
    for i in range(3):
        rgba = np.dstack([picture(i), disc() // 5 * 4])
        Image.fromarray(rgba).save(photos / f"{i}.png")
    views = stages.ingest(photos, max_side=64)
    assert views.background == "removed"
    mask_path = views.mask_path(views.items[0])
    assert mask_path is not None
    np.testing.assert_array_equal(read_png(mask_path), disc() // 5 * 4)
    np.testing.assert_array_equal(read_png(views.image_path(views.items[0])), picture(0))


def test_colour_behind_transparency_does_not_bleed_when_reduced(
    stages: Stages, photos: Path
) -> None:
    color = np.where(disc()[..., None] > 0, [200, 50, 50], [0, 255, 0]).astype(np.uint8)
    for i in range(3):
        rgba = np.dstack([color, np.where(disc() > 0, 255, 0).astype(np.uint8)])
        rgba = np.roll(rgba, 5 * i, axis=1)  # three photos, no copies
        Image.fromarray(rgba).resize((640, 480), Image.Resampling.NEAREST).save(photos / f"{i}.png")
    views = stages.ingest(photos, max_side=90)
    mask_path = views.mask_path(views.items[0])
    assert mask_path is not None
    inside = read_png(mask_path) > 25
    color_inside = read_png(views.image_path(views.items[0]))[inside]
    assert np.abs(color_inside - np.array([200, 50, 50])).max() <= 3


def test_an_opaque_alpha_channel_is_no_mask(stages: Stages, photos: Path) -> None:
    for i in range(3):
        Image.fromarray(np.dstack([picture(i), np.full((48, 64), 255, np.uint8)])).save(
            photos / f"{i}.png"
        )
    assert stages.ingest(photos).background == "photo"


def test_broken_photos_are_skipped_with_their_reasons(stages: Stages, photos: Path) -> None:
    paths = write_photos(photos, 5)
    data = paths[1].read_bytes()
    paths[1].write_bytes(data[: len(data) // 2])
    paths[3].write_bytes(b"")
    (photos / "notes.txt").write_text("shot on Sunday")
    (photos / ".hidden.jpg").write_bytes(b"x")
    views = stages.ingest(photos)
    assert [view.name for view in views.items] == ["IMG_0", "IMG_2", "IMG_4"]
    reasons = {skipped.name: skipped for skipped in views.skipped}
    assert set(reasons) == {"IMG_1.jpg", "IMG_3.jpg"}
    assert not reasons["IMG_1.jpg"].harmless
    (warning,) = stages.warnings
    assert "IMG_1.jpg" in warning and "IMG_3.jpg: empty" in warning and "notes" not in warning


def test_a_missing_path_says_so(stages: Stages, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="nowhere: no such file or folder"):
        stages.ingest(tmp_path / "nowhere")


def test_an_empty_folder_says_so(stages: Stages, photos: Path) -> None:
    with pytest.raises(CaptureError, match="holds no files"):
        stages.ingest(photos)


def test_a_folder_of_text_files_says_so(stages: Stages, photos: Path) -> None:
    for i in range(4):
        (photos / f"{i}.txt").write_text("text")
    with pytest.raises(CaptureError, match=r"none of the 4 files is a photo \(0.txt"):
        stages.ingest(photos)


def test_two_photos_are_too_few(stages: Stages, photos: Path) -> None:
    write_photos(photos, 2)
    with pytest.raises(CaptureError, match="found 2 usable photos, at least 3 are needed"):
        stages.ingest(photos)


def test_photos_may_lie_in_a_sub_folder_called_images(stages: Stages, photos: Path) -> None:
    write_photos(photos / "images")
    (photos / "README.txt").write_text("a workspace")
    assert [view.source for view in stages.ingest(photos).items] == [
        f"IMG_{i}.jpg" for i in range(3)
    ]


def test_names_are_unique_and_in_natural_order(stages: Stages, photos: Path) -> None:
    for i, name in enumerate(("IMG_10.jpg", "IMG_2.jpg", "IMG_2.png", "a b.jpg")):
        Image.fromarray(picture(i)).save(photos / name)
    views = stages.ingest(photos)
    sources = [view.source for view in views.items]
    assert sources == ["IMG_2.jpg", "IMG_2.png", "IMG_10.jpg", "a b.jpg"]
    names = [view.name for view in views.items]
    assert len({name.lower() for name in names}) == 4 and not any(" " in name for name in names)


def test_every_eighth_of_enough_photos_is_held_out(stages: Stages, photos: Path) -> None:
    write_photos(photos, 17)
    splits = [view.split for view in stages.ingest(photos).items]
    assert [i for i, split in enumerate(splits) if split == "test"] == [4, 12]


def test_nothing_is_held_out_of_few_photos_or_when_told_so(tmp_path: Path) -> None:
    write_photos(tmp_path / "few", 15)
    write_photos(tmp_path / "many", 17)
    few = Stages(tmp_path / "w1").ingest(tmp_path / "few")
    many = Stages(tmp_path / "w2").ingest(tmp_path / "many", holdout=0)
    assert {view.split for view in (*few.items, *many.items)} == {"train"}


def test_a_blurred_photo_is_named_but_kept(stages: Stages, photos: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(8):
        noise = Image.fromarray(rng.integers(0, 255, (96, 128, 3), np.uint8))
        noise = noise.resize((16, 12)).resize((128, 96)) if i == 5 else noise
        noise.save(photos / f"{i}.png")
    assert len(stages.ingest(photos).items) == 8
    (warning,) = stages.warnings
    assert "1 photos look blurred" in warning and "5.png" in warning


def test_the_capture_lists_what_ingest_reads(photos: Path) -> None:
    write_photos(photos)
    (photos / "masks").mkdir()
    Image.fromarray(disc()).save(photos / "masks" / "IMG_0.png")
    (photos / ".DS_Store").write_bytes(b"x")
    names = [name for name, _ in Capture((photos,)).files()]
    assert names == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg", "masks/IMG_0.png"]


@needs_shared
def test_raw_photos_become_linear_and_match_the_camera_jpegs(tmp_path: Path) -> None:
    """DNGs and JPEGs of the same rendering; what remains is demosaicing and JPEG noise."""
    capture = SHARED / "kettle_capture"
    names = ["IMG_0000", "IMG_0006", "IMG_0013"]
    raw = Stages(tmp_path / "raw").ingest(*(capture / "dng" / f"{n}.dng" for n in names))
    jpeg = Stages(tmp_path / "jpg").ingest(*(capture / "images" / f"{n}.jpg" for n in names))
    assert (raw.color_space, jpeg.color_space) == ("linear", "srgb")
    for a, b in zip(raw.items, jpeg.items, strict=True):
        linear = read_png(raw.image_path(a))
        assert linear.dtype == np.uint16
        encoded = srgb_from_linear(linear.astype(np.float32) / 65535)
        error = encoded - read_png(jpeg.image_path(b)) / 255
        assert np.abs(error).mean() < 0.02
        assert np.abs(error.mean((0, 1))).max() < 0.003  # one white balance, one exposure
        assert a.exif.focal_mm == b.exif.focal_mm
        assert a.exposure == pytest.approx(b.exposure, rel=0.01)


@needs_shared
def test_raw_is_told_by_content_and_broken_raw_is_skipped(stages: Stages, photos: Path) -> None:
    for i in range(4):
        shutil.copyfile(SHARED / "kettle_capture" / "dng" / f"IMG_000{i}.dng", photos / f"{i}.tif")
    data = (photos / "2.tif").read_bytes()
    (photos / "2.tif").write_bytes(data[: len(data) // 2])
    Image.fromarray(picture()).save(photos / "1.jpg")  # the camera's own JPEG beside the RAW
    views = stages.ingest(photos)
    assert [view.name for view in views.items] == ["0", "1_tif", "3"]
    assert views.color_space == "linear"
    reasons = {skipped.name: skipped.reason for skipped in views.skipped}
    assert "camera RAW" in reasons["1.jpg"] and "2.tif" in reasons["2.tif"]


@needs_shared
def test_structure_from_motion_gets_eight_bit_srgb_of_raw_photos(tmp_path: Path) -> None:
    capture = SHARED / "kettle_capture"
    names = ["IMG_0000", "IMG_0006", "IMG_0013"]
    sides = {"max_side": 200, "placing_side": 400}
    raw = Stages(tmp_path / "raw").ingest(*(capture / "dng" / f"{n}.dng" for n in names), **sides)
    jpeg = Stages(tmp_path / "jpg").ingest(
        *(capture / "images" / f"{n}.jpg" for n in names), **sides
    )
    for a, b in zip(raw.items, jpeg.items, strict=True):
        developed, taken = read_png(raw.placing_path(a)), read_png(jpeg.placing_path(b))
        assert developed.dtype == np.uint8 and developed.shape == taken.shape == (300, 400, 3)
        assert np.abs(developed.astype(float) - taken).mean() < 5


@needs_shared
def test_mixed_raw_and_jpeg_are_all_srgb(stages: Stages, photos: Path) -> None:
    capture = SHARED / "kettle_capture"
    shutil.copyfile(capture / "dng" / "IMG_0000.dng", photos / "a.dng")
    for name in ("IMG_0001", "IMG_0002"):
        shutil.copyfile(capture / "images" / f"{name}.jpg", photos / f"{name}.jpg")
    views = stages.ingest(photos)
    assert views.color_space == "srgb"
    exposures = [view.exposure for view in views.items]
    assert max(exposures) < 1.2 * min(exposures)


@needs_shared
def test_raw_photos_of_different_exposures_are_brought_to_one() -> None:
    path = SHARED / "kettle_capture" / "dng" / "IMG_0000.dng"
    exif = read_exif(path)
    longer = replace(exif, exposure_s=2 * (exif.exposure_s or 0))
    plan = plan_development([(path, exif), (path, longer), (path, longer)])
    assert plan.exposure == exposure_of(longer)
    as_is = develop(path, longer, plan).astype(float)
    raised = develop(path, exif, plan).astype(float)
    unclipped = as_is < 30000
    np.testing.assert_allclose(raised[unclipped], 2 * as_is[unclipped], atol=1)
    same = plan_development([(path, exif), (path, exif)])
    assert same.exposure is None and same.white_balance[1] == 1.0
