"""Nobody sees where a texture was cut: not close by, and not in the mips of what is far away."""

from dataclasses import replace

import numpy as np
import pytest
from finished import appearance
from scenes import Scene, Sphere, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh, UvMesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.relight import Relit
from refdgs_pipe.texture import charts
from refdgs_pipe.texture.material import Painter
from refdgs_pipe.texture.refining import Refiner
from refdgs_pipe.texture.texels import rasterize

SIZE = 1024


@pytest.fixture(scope="module")
def painted() -> TexturedMesh:
    """A ball with smooth colours, cut by UVAtlas as a run cuts it."""
    solid = sphere(40)
    mesh = charts.unwrap(
        Mesh(solid.vertices, solid.faces), gutter=4 / 1024, max_stretch=0.05, timeout_s=120
    ).mesh
    scene = Scene((Sphere((0, 0, 0), 1.0, waves, roughness=0.3),), gradient_sky)
    painter = Painter(mesh, SIZE, tolerance=0.03)
    for camera in orbit(24, size=200, focal=300):
        painter.add(scene.surface_map(camera))
    return painter.paint(appearance(mesh.vertices))


@pytest.fixture(scope="module", params=[(8, 160), (24, 200)], ids=["coarse", "fine"])
def corrected(request: pytest.FixtureRequest, painted: TexturedMesh) -> TexturedMesh:
    """The ball, painted too dark, after photos: few and small ones, or many."""
    count, side = request.param
    matte = replace(painted, metallic=np.zeros_like(painted.metallic))
    dark = replace(matte, base_color=(0.75 * matte.base_color).astype(np.uint16))
    sky = np.full((16, 32, 3), 0.8, np.float32)
    right, refiner = Relit(matte, sky), Refiner(dark, Relit(dark, sky), near=0.05, photos=count)
    for camera in orbit(count, size=side, focal=1.5 * side):
        rgb, alpha = right.draw(camera)
        refiner.add(Photo(camera, rgb, alpha, np.ones(alpha.shape, bool)))
    return refiner.refined()


def mip(picture: np.ndarray, level: int) -> np.ndarray:
    """As a renderer makes it: boxes of 2^level texels."""
    side = len(picture) >> level
    boxes = picture.reshape(side, 1 << level, side, 1 << level, -1).astype(np.float64)
    return np.asarray(boxes.mean((1, 3)))


def look(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear, clamped at the border."""
    place = np.clip(uv * len(picture) - 0.5, 0, len(picture) - 1.001)
    low, part = np.floor(place).astype(int), place % 1
    (x, y), (fx, fy) = low.T, part.T[..., None]
    upper = picture[y, x] * (1 - fx) + picture[y, x + 1] * fx
    lower = picture[y + 1, x] * (1 - fx) + picture[y + 1, x + 1] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def seams(mesh: UvMesh) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2) texture coordinates of the same places on both sides of cuts."""
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    solid = np.sort(same.reshape(-1)[edges], axis=1)
    turned = np.where((same.reshape(-1)[edges] == solid).all(1)[:, None], edges, edges[:, ::-1])
    order = np.lexsort(solid.T)
    solid, turned = solid[order], turned[order]
    pairs = np.flatnonzero((solid[1:] == solid[:-1]).all(1))
    one, other = turned[pairs], turned[pairs + 1]
    cut = (one != other).any(1)
    middle = [mesh.uv[ends[cut]].mean(1) for ends in (one, other)]
    return middle[0], middle[1]


def assert_no_cut_shows(
    textured: TexturedMesh, name: str, level: int, *, share: float = 1.0
) -> None:
    """Steps across cuts, or across a share of them, are no larger than those beside them."""
    picture = mip(getattr(textured, name) / 65535, level)
    one, other = seams(textured.mesh)
    assert len(one) > 100
    across = np.abs(look(picture, one) - look(picture, other)).max(1)
    # Inside the charts: between points as far apart as the texels that the two sides are made of.
    inside = textured.mesh.uv[textured.mesh.faces].mean(1)
    apart = 2.0 * (1 << level) / SIZE
    steps = [
        np.abs(look(picture, inside) - look(picture, inside + np.array(step))).max(1)
        for step in ((apart, 0), (0, apart))
    ]
    assert np.quantile(across, share) <= max(found.max() for found in steps) + 1 / 255


@pytest.mark.parametrize("level", range(5))
@pytest.mark.parametrize("name", ["base_color", "roughness", "occlusion"])
def test_a_cut_is_no_larger_a_step_than_there_is_beside_it(
    painted: TexturedMesh, name: str, level: int
) -> None:
    assert_no_cut_shows(painted, name, level)


@pytest.mark.parametrize("level", range(5))
def test_nor_is_it_once_photos_have_corrected_the_colours(
    painted: TexturedMesh, corrected: TexturedMesh, level: int
) -> None:
    assert (corrected.base_color != painted.base_color).any()
    # From the first mip on no cut shows; in the texture itself a few do, where few photos see one.
    assert_no_cut_shows(corrected, "base_color", level, share=1.0 if level else 0.9)


def test_every_texel_of_a_chart_is_filled(painted: TexturedMesh) -> None:
    texels = rasterize(painted.mesh, SIZE)
    normal = painted.normal.reshape(-1, 3)[texels.index] / 65535 * 2 - 1
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 0.01
    assert (painted.base_color.reshape(-1, 3)[texels.index] > 0).all()
    assert (painted.confidence.reshape(-1)[texels.index] > 0).mean() > 0.99
