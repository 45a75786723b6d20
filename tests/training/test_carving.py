"""Hollows open where photos agree on what lies behind, and nowhere else."""

import numpy as np
import pytest
import torch
from scenes import Box, Scene, Sphere, constant, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import Camera
from refdgs_pipe.training import initial
from refdgs_pipe.training.carving import boundary, empty_cells

THICK, HALF, DEPTH = 0.15, 0.7, 0.5


def open_box() -> Scene:
    """A box without a lid, its pit 0.5 deep; floor below z = -0.25."""
    low, high, inner = -DEPTH / 2 - THICK, DEPTH / 2, HALF - THICK
    walls = (
        ((-HALF, -HALF, low), (-inner, HALF, high)),
        ((inner, -HALF, low), (HALF, HALF, high)),
        ((-HALF, -HALF, low), (HALF, -inner, high)),
        ((-HALF, inner, low), (HALF, HALF, high)),
        ((-HALF, -HALF, low), (HALF, HALF, -DEPTH / 2)),
    )
    return Scene(tuple(Box(a, b, waves) for a, b in walls), gradient_sky)


def hull_of(
    scene: Scene, pictures: str = "true"
) -> tuple[initial.Hull, list[torch.Tensor], list[torch.Tensor], list[Camera]]:
    """The scene's visual hull and its photos; "noise": photos that agree on nothing."""
    cameras = [c for c in orbit(90, size=128, focal=170) if c.center[2] > -1]
    maps = [scene.surface_map(camera) for camera in cameras]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial, "HULL_CELLS", 96)
        hull = initial.visual_hull(Ball(np.zeros(3), 1.3), cameras, [m.alpha for m in maps])
    assert hull is not None
    rng = torch.Generator().manual_seed(0)
    colors = [torch.from_numpy(m.color).permute(2, 0, 1).contiguous() for m in maps]
    if pictures == "noise":
        blobs = (torch.rand(1, 3, 6, 6, generator=rng) for _ in colors)
        colors = [
            torch.nn.functional.interpolate(blob, (128, 128), mode="bicubic")[0].clamp(0, 1)
            for blob in blobs
        ]
    return hull, colors, [torch.from_numpy(m.alpha) for m in maps], cameras


def test_the_pit_of_an_open_box_is_found_and_its_walls_stay() -> None:
    hull, colors, masks, cameras = hull_of(open_box())
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    sideways, margin = np.maximum(np.abs(x), np.abs(y)), 1.5 * hull.cell
    pit = (sideways < HALF - THICK - margin) & (z > -DEPTH / 2 + margin) & hull.cells
    solid = hull.cells & ((sideways > HALF - THICK + margin) | (z < -DEPTH / 2 - margin))
    assert pit.sum() > 5_000  # silhouettes cannot see it
    assert empty[pit].mean() > 0.6
    assert empty[solid].mean() < 0.01


def test_photos_that_agree_on_nothing_open_nothing() -> None:
    hull, colors, masks, cameras = hull_of(open_box(), "noise")
    assert empty_cells(hull.cells, hull.axes(), cameras, colors, masks).mean() < 1e-3


def test_a_convex_matte_body_stays_whole() -> None:
    ball = Scene((Sphere((0.0, 0.0, 0.0), 0.8, waves),), gradient_sky)
    hull, colors, masks, cameras = hull_of(ball)
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    assert empty.sum() < 0.01 * hull.cells.sum()


def test_a_plain_body_stays_whole() -> None:
    plain = Scene((Sphere((0.0, 0.0, 0.0), 0.8, constant(0.4, 0.3, 0.2)),), gradient_sky)
    hull, colors, masks, cameras = hull_of(plain)
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    assert empty.sum() < 0.01 * hull.cells.sum()


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_photos_open_nothing(count: int) -> None:
    hull, colors, masks, cameras = hull_of(open_box())
    few = (cameras[:count], colors[:count], masks[:count])
    assert not empty_cells(hull.cells, hull.axes(), *few).any()


def test_the_boundary_of_a_cube_is_its_outer_layer() -> None:
    cells = np.zeros((7, 7, 7), bool)
    cells[1:6, 1:6, 1:6] = True
    assert boundary(cells).sum() == 5**3 - 3**3
    assert boundary(np.ones((3, 3, 3), bool)).sum() == 26
