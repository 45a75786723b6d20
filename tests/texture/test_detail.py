"""Fine detail of base colours comes from the photos, as far as they agree on it."""

from dataclasses import replace

import numpy as np
import pytest
from painted import textured
from scenes import look_at

from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.relight import Relit
from refdgs_pipe.texture.detail import Detail, scale_for
from refdgs_pipe.texture.texels import rasterize

SIZE, SIDE = 512, 256
SKY = np.full((16, 32, 3), 0.7, np.float32)
CAMERAS = [
    look_at(
        f"v{i}",
        [0, 0, 1] + 4 * np.array([np.cos(i), np.sin(i), 0.2 * (i % 3)]),
        size=SIDE,
        focal=336,
    )
    for i in range(6)
]


def asset(*, print_: float, level: float = 0.4) -> TexturedMesh:
    """A matte ball of this linear grey with fine print of this contrast."""
    plain = textured(SIZE)
    texels = rasterize(plain.mesh, SIZE)
    x, y, z = texels.interpolate(plain.mesh, plain.mesh.vertices).T
    fine = level + print_ * np.sign(np.sin(40 * z) * np.sin(25 * (x + 0.7 * y)))
    coded = srgb_from_linear(np.repeat(fine[:, None], 3, 1).astype(np.float32))
    return replace(
        plain,
        base_color=texels.picture(np.round(coded * 65535).astype(np.uint16)),
        metallic=np.zeros_like(plain.metallic),
        roughness=np.full_like(plain.roughness, 60000),
    )


def photos(of: TexturedMesh) -> list[Photo]:
    light = Relit(of, SKY)
    drawn = [(camera, *light.draw(camera)) for camera in CAMERAS]
    return [Photo(c, rgb, alpha, np.ones(alpha.shape, bool)) for c, rgb, alpha in drawn]


def added(before: TexturedMesh, shots: list[Photo], threads: int = 1) -> TexturedMesh:
    received = np.full((len(before.mesh.vertices), 3), 0.68, np.float32)
    detail = Detail(before, received, near=0.02, threads=threads)
    for shot in shots:
        detail.add(shot)
    return detail.added()


@pytest.fixture(scope="module")
def shots() -> list[Photo]:
    return photos(asset(print_=0.15))


@pytest.fixture(scope="module")
def found(shots: list[Photo]) -> TexturedMesh:
    return added(asset(print_=0.0), shots)


def apart(one: TexturedMesh, other: TexturedMesh) -> np.ndarray:
    """How far colours lie apart on the part of the ball that all cameras see well."""
    texels = rasterize(one.mesh, SIZE)
    height = texels.interpolate(one.mesh, one.mesh.vertices)[:, 2]
    there = texels.index[np.abs(height - 1.2) < 0.4]
    both = [asset.base_color.reshape(-1, 3)[there].astype(float) / 65535 for asset in (one, other)]
    return np.abs(both[0] - both[1])


def test_print_that_all_photos_show_gets_into_the_colours(found: TexturedMesh) -> None:
    true, plain = asset(print_=0.15), asset(print_=0.0)
    assert apart(found, true).mean() < 0.5 * apart(plain, true).mean()


def test_what_one_photo_shows_alone_does_not() -> None:
    """A reflection of stripes in the photo that sees a side best."""
    plain = asset(print_=0.0)
    wave = np.sign(np.sin(np.arange(SIDE) * 2 * np.pi / 7))[None, :, None]
    stripes = (0.9 + 0.1 * wave).astype(np.float32)
    same = photos(plain)
    mirrored = replace(same[0], rgb=same[0].rgb * stripes)
    assert apart(added(plain, [mirrored, *same[1:]]), plain).mean() < 0.004
    assert apart(added(plain, [mirrored, mirrored]), plain).mean() > 0.01  # were it print


def test_what_black_gloss_mirrors_does_not_though_all_photos_agree() -> None:
    """The edges of its faces: there all photos show a step, five times as bright as the surface."""
    mirrored = photos(asset(print_=0.03, level=0.05))
    black, grey = (asset(print_=0.0, level=level) for level in (0.01, 0.05))
    assert apart(added(black, mirrored), black).mean() < 1e-3
    assert apart(added(grey, mirrored), grey).mean() > 0.02  # were it the surface's own


def test_a_metal_has_no_print(shots: list[Photo]) -> None:
    metal = replace(asset(print_=0.0), metallic=np.full((SIZE, SIZE), 65535, np.uint16))
    assert apart(added(metal, shots), metal).max() < 1e-4


def test_the_number_of_threads_changes_nothing(shots: list[Photo], found: TexturedMesh) -> None:
    again = added(asset(print_=0.0), shots, threads=3)
    np.testing.assert_array_equal(again.base_color, found.base_color)


def test_photos_are_read_as_large_as_texels_need() -> None:
    mesh, camera = asset(print_=0.0).mesh, CAMERAS[0]
    assert scale_for(mesh, SIZE, camera) == 1
    finer, finest = (scale_for(mesh, SIZE, camera.resized(k * SIDE, k * SIDE)) for k in (4, 8))
    assert finest == pytest.approx(finer / 2) and finer < 1
