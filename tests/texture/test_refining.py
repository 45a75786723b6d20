"""Base colours are corrected by the photos, and reflections do not end up in them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from painted import textured
from scenes import look_at

from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.relight import Relit
from refdgs_pipe.texture.refining import Pixels, Refiner, correction

SIDE = 32


def pattern() -> np.ndarray:
    """(S, S, 3) linear, with stripes of six texels."""
    row, column = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    wave = 0.4 + 0.2 * np.sin(column * 2 * np.pi / 6) * np.cos(row * 2 * np.pi / 9)
    return np.stack([wave, 0.5 * wave, 0.7 - 0.5 * wave], -1).astype(np.float32)


def pixels(base: np.ndarray, *, mirrored: float = 0.02, count: int = 6000) -> Pixels:
    """What a surface with these colours shows at random places."""
    random = np.random.default_rng(0)
    uv = random.uniform(0.05, 0.95, (count, 1, 2)).astype(np.float32)
    uv = uv + np.float32(0.4 / SIDE) * random.uniform(-1, 1, (count, 4, 2)).astype(np.float32)
    look = cv2.remap(
        base, *(np.ascontiguousarray(uv[..., i] * SIDE - 0.5) for i in (0, 1)), cv2.INTER_LINEAR
    ).mean(1)
    received = np.full((count, 3), 0.8, np.float32)
    shine = np.full((count, 3), mirrored, np.float32)
    photo = srgb_from_linear(look * received + shine)
    return Pixels(uv, received, shine, np.ones(count, np.float32), photo)


def inner(picture: np.ndarray) -> np.ndarray:
    return picture[4:-4, 4:-4]


def test_blurred_colours_become_those_that_the_photos_show() -> None:
    true = pattern()
    blurred = cv2.GaussianBlur(true, (0, 0), 2.0)
    found = blurred + correction(pixels(true), blurred)
    assert np.abs(inner(found - true)).mean() < 0.2 * np.abs(inner(blurred - true)).mean()


def test_right_colours_stay() -> None:
    true = pattern()
    assert np.abs(inner(correction(pixels(true), true))).max() < 0.01


def test_a_reflection_that_some_photos_show_does_not_get_into_the_colours() -> None:
    true = pattern()
    seen = pixels(true)
    photo = seen.photo.copy()
    photo[::10] = 0.98  # one in ten shows a lamp
    change = correction(replace(seen, photo=photo), true)
    assert np.abs(inner(change)).mean() < 0.02


def test_what_is_not_matte_is_left_alone() -> None:
    true = pattern()
    nothing = replace(pixels(true), matte=np.zeros(6000, np.float32))
    np.testing.assert_array_equal(correction(nothing, 0.5 * true), 0)


CAMERAS = [
    look_at(f"v{i}", 4 * np.array([np.cos(i), np.sin(i), 0.35 * (i % 3)]), size=64, focal=70)
    for i in range(6)
]
SKY = np.full((16, 32, 3), 0.7, np.float32)


@pytest.fixture(scope="module")
def true() -> TexturedMesh:
    return textured()


@pytest.fixture(scope="module")
def refined(true: TexturedMesh) -> TexturedMesh:
    """Of an asset that is too dark, by photos of the right one."""
    refiner = Refiner(dimmed(true), Relit(dimmed(true), SKY), near=0.05, photos=len(CAMERAS))
    for photo in photos(Relit(true, SKY)):
        assert refiner.add(photo)
    return refiner.refined()


def dimmed(asset: TexturedMesh) -> TexturedMesh:
    return replace(asset, base_color=(asset.base_color * 0.85).astype(np.uint16))


def photos(asset: Relit) -> list[Photo]:
    def taken(camera: Camera) -> Photo:
        rgb, alpha = asset.draw(camera)
        return Photo(camera, rgb, alpha, np.ones(alpha.shape, bool))

    return [taken(camera) for camera in CAMERAS]


def test_an_asset_comes_to_look_as_its_photos_do(true: TexturedMesh, refined: TexturedMesh) -> None:
    camera = look_at("new", 4 * np.array([0.8, -0.6, 0.2]), size=64, focal=70)
    wanted, alpha = Relit(true, SKY).draw(camera)
    matte = alpha > 0.99
    matte[:18] = False  # the upper half is metal
    dim, found = (Relit(a, SKY).draw(camera)[0] for a in (dimmed(true), refined))
    off = [float(np.abs(picture - wanted)[matte].mean()) for picture in (dim, found)]
    assert off[1] < 0.35 * off[0]


def test_metals_and_other_textures_stay(true: TexturedMesh, refined: TexturedMesh) -> None:
    before = dimmed(true)
    metal = cv2.erode((true.metallic > 60000).astype(np.uint8), np.ones((5, 5))) > 0
    assert metal.sum() > 1000
    apart = refined.base_color[metal].astype(int) - before.base_color[metal]
    assert np.abs(apart).max() <= 1  # rounding
    for name in ("roughness", "metallic", "normal", "occlusion", "confidence"):
        np.testing.assert_array_equal(getattr(refined, name), getattr(before, name))


def test_without_a_pixel_that_tells_anything_nothing_changes(true: TexturedMesh) -> None:
    refiner = Refiner(true, Relit(true, SKY), near=0.05, photos=1)
    dark = np.zeros((64, 64), np.float32)
    white = Photo(CAMERAS[0], np.ones((64, 64, 3), np.float32), dark, dark == 0)
    assert refiner.add(white) == 0
    assert refiner.refined() is true
