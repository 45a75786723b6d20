"""Adding copies of photos changes nothing; photos from almost the same place are no copies."""

import shutil
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import SHARED, Stages, needs_shared
from PIL import Image

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.imaging.copies import are_copies, look_of


def scene(seed: int, height: int = 300, width: int = 400) -> np.ndarray:
    """(H, W, 3) uint8 with detail at several scales."""
    rng = np.random.default_rng(seed)
    out = np.zeros((height, width, 3), np.float32)
    for cells in (4, 16, 60):
        small = rng.normal(0, 40, (cells, cells, 3)).astype(np.float32)
        out += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return (out + 128).clip(0, 255).astype(np.uint8)


def as_jpeg(pixels: np.ndarray, quality: int, scale: float = 1.0) -> np.ndarray:
    image = Image.fromarray(pixels)
    size = (round(image.width * scale), round(image.height * scale))
    file = BytesIO()
    image.resize(size, Image.Resampling.LANCZOS).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


def records(views: Views) -> list[dict]:
    found = []
    for view in views.items:
        record = {k: v for k, v in vars(view).items() if k != "exif"} | asdict(view.exif)
        record["pixels"] = views.image_path(view).read_bytes()
        record["larger"] = views.placing_path(view).read_bytes()
        found.append(record)
    return found


def test_a_capture_doubled_by_copies_gives_bit_for_bit_the_same_views(tmp_path: Path) -> None:
    plain, doubled = tmp_path / "plain", tmp_path / "doubled"
    plain.mkdir()
    for i in range(17):
        Image.fromarray(scene(i)).save(plain / f"IMG_{i}.jpg", quality=92)
    shutil.copytree(plain, doubled)
    (doubled / "again").mkdir()
    for i in range(17):
        photo = doubled / f"IMG_{i}.jpg"
        if i % 4 == 0:
            shutil.copyfile(photo, doubled / f"IMG_{i} (1).jpg")
        elif i % 4 == 1:
            Image.open(photo).save(doubled / "again" / f"IMG_{i}.jpg", quality=60)
        elif i % 4 == 2:
            Image.open(photo).resize((200, 150), Image.Resampling.LANCZOS).save(
                doubled / f"IMG_{i}_small.jpg", quality=80
            )
        else:
            exif = Image.Exif()
            exif[0x0131] = "another program"
            Image.open(photo).save(doubled / f"IMG_{i}.png", exif=exif)
    sides = {"max_side": 256, "placing_side": 320}
    first = Stages(tmp_path / "w1").ingest(plain, **sides)
    stages = Stages(tmp_path / "w2")
    second = stages.ingest(doubled, **sides)
    assert records(first) == records(second)
    assert len(list((second.folder / "images").iterdir())) == 17
    reasons = {skipped.name: skipped.reason for skipped in second.skipped}
    assert len(reasons) == 17
    assert reasons["IMG_0 (1).jpg"] == "copy of IMG_0.jpg"
    assert reasons["again/IMG_1.jpg"] == "copy of IMG_1.jpg"
    assert reasons["IMG_3.png"] == "copy of IMG_3.jpg"
    (warning,) = stages.warnings
    assert "17 files are copies" in warning and "IMG_0 (1).jpg (copy of IMG_0.jpg)" in warning


def test_the_larger_of_two_copies_is_kept(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(scene(i)).save(tmp_path / f"{i}_as_taken.png")
        Image.fromarray(scene(i)).resize((200, 150)).save(tmp_path / f"{i}.jpg")
    views = Stages(tmp_path / "w").ingest(tmp_path)
    assert [view.source for view in views.items] == [f"{i}_as_taken.png" for i in range(3)]


@pytest.mark.parametrize("pixels", [1, 2, 5])
def test_a_burst_from_a_moving_hand_is_no_set_of_copies(pixels: int) -> None:
    """1 to 5 of 1600 pixels; the later photo has noise of its own."""
    wide = scene(3, 1200, 1605)
    rng = np.random.default_rng(0)
    one, other = (
        (part + rng.normal(0, 2, part.shape)).clip(0, 255).astype(np.uint8)
        for part in (wide[:, :1600], wide[:, pixels : pixels + 1600])
    )
    assert not are_copies(look_of(one, linear=False), look_of(other, linear=False))


def test_the_same_place_with_something_moved_is_no_copy() -> None:
    one = scene(4, 480, 640)
    other = one.copy()
    other[200:280, 280:360] = one[200:280, 284:364]
    assert not are_copies(look_of(one, linear=False), look_of(other, linear=False))


@needs_shared
def test_no_photo_of_a_turntable_is_a_copy_and_every_copy_of_one_is() -> None:
    folder = SHARED / "kettle_turntable" / "images"
    photos = [np.asarray(Image.open(p)) for p in sorted(folder.glob("*.jpg"))[:20]]
    looks = [look_of(photo, linear=False) for photo in photos]
    pairs = [(i, j) for i in range(len(looks)) for j in range(i)]
    assert [pair for pair in pairs if are_copies(looks[pair[0]], looks[pair[1]])] == []
    for photo, look in zip(photos[:5], looks[:5], strict=True):
        for quality, scale in ((30, 1.0), (60, 1.0), (85, 0.75), (80, 0.5), (75, 1.6)):
            copy = as_jpeg(photo, quality, scale)
            assert are_copies(look, look_of(copy, linear=False)), (quality, scale)
