"""Photos cut to the object: what is kept, at what size, and where it lies."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from training.test_trainer import capture

from refdgs_pipe.training.photos import FILL, cropped, framing_scale, load_training_photos, shrunk


def test_a_small_object_is_reduced_less_than_its_photo(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=256)
    model = replace(model, ball=replace(model.ball, radius=model.ball.radius / 6))
    whole = load_training_photos(views, model, max_side=64, near=0.01)
    framed = load_training_photos(views, model, max_side=64, near=0.01, framed=True)
    for camera, before, after in zip(model.cameras, whole, framed, strict=True):
        scale = framing_scale(camera, model.ball, 64)
        distance = np.linalg.norm(camera.center - model.ball.center)
        across = 2 * model.ball.radius * camera.K[0, 0] * scale / distance
        assert np.isclose(across, FILL * 64) or scale == 1.0
        assert after.camera.K[0, 0] > 1.5 * before.camera.K[0, 0]


def test_a_crop_keeps_the_objects_pixels_where_the_camera_says(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=256)
    for photo in load_training_photos(views, model, max_side=256, near=0.01):
        assert photo.mask is not None
        photo = replace(photo, mask=photo.mask.clone())
        photo.mask[:100] = 0  # the object's lower part alone
        part = cropped(photo, 256)
        assert part.mask is not None and part.camera.height < photo.camera.height
        assert int((part.mask > 0).sum()) == int((photo.mask > 0).sum())
        shift = photo.camera.K[:2, 2] - part.camera.K[:2, 2]
        left, top = (round(value) for value in shift)
        np.testing.assert_allclose(shift, [left, top], atol=1e-9)
        rows = slice(top, top + part.camera.height)
        columns = slice(left, left + part.camera.width)
        assert torch.equal(part.rgb, photo.rgb[:, rows, columns])
        assert (part.pinhole.width, part.pinhole.height) == part.rgb.shape[:0:-1]
        assert part.pinhole.cx == part.camera.K[0, 2]


def test_crops_have_few_sizes(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=256)
    framed = load_training_photos(views, model, max_side=256, near=0.01, framed=True)
    assert all(p.camera.width % 64 == 0 and p.camera.height % 64 == 0 for p in framed)


def test_a_photo_that_shows_nothing_of_the_object_stays_whole(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=128)
    (photo, *_) = load_training_photos(views, model, max_side=128, near=0.01)
    assert photo.mask is not None
    empty = replace(photo, mask=torch.zeros_like(photo.mask))
    assert cropped(empty, 128) is empty
    bare = replace(photo, mask=None)
    assert cropped(bare, 128) is bare


def test_densification_compares_as_in_a_usual_photo(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=256)
    whole = load_training_photos(views, model, max_side=256, near=0.01)
    assert all(photo.lever == photo.camera.width / 2 for photo in whole)
    framed = load_training_photos(views, model, max_side=256, near=0.01, framed=True)
    frames = {photo.frame for photo in framed}
    assert len(frames) == 1  # recorded steps hold it
    (frame,) = frames
    assert frame is not None and 0 < frame <= whole[0].camera.height
    for photo in framed:  # of a mean over the frame, by half its width
        pixels = photo.camera.width * photo.camera.height
        assert np.isclose(photo.lever, pixels / frame**2 * frame / 2)
        half = shrunk(photo, 0.5)
        assert half.frame == frame / 2
        assert np.isclose(half.lever, photo.lever / 2)


def test_a_photo_without_the_object_is_reduced_as_before(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=256)
    model = replace(model, ball=replace(model.ball, radius=model.ball.radius / 6))
    mask = views.mask_path(views[model.cameras[0].name])
    assert mask is not None
    with Image.open(mask) as found:
        Image.new(found.mode, found.size, 0).save(mask)
    first, second, *_ = load_training_photos(views, model, max_side=64, near=0.01, framed=True)
    assert max(first.camera.width, first.camera.height) == 64
    assert second.camera.K[0, 0] > 1.5 * first.camera.K[0, 0]
