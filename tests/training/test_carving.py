"""Hollows open where photos agree on what lies behind or a volume shows them, and nowhere else."""

from functools import cache

import numpy as np
import pytest
import torch
from scenes import Box, Scene, Sphere, constant, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import Cancelled
from refdgs_pipe.training import initial, volume
from refdgs_pipe.training.carving import boundary, empty_cells, needed_by_masks
from refdgs_pipe.training.volume import _around, hollow_cells

THICK, HALF, DEPTH = 0.15, 0.7, 0.5
Seen = tuple[initial.Hull, list[torch.Tensor], list[torch.Tensor], list[Camera]]
FINE = {"cells": 68, "views": 60, "size": 96}


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Several only wait for each other in so small work."""
    torch.set_num_threads(1)


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


@cache
def hull_of_box() -> Seen:
    """As `hull_of`, of the open box in large cells."""
    return hull_of("box")


VOLUMES: dict[int, torch.Tensor] = {}  # of the open box, by seed


def hollows_of_box(ground: np.ndarray | None = None) -> np.ndarray:
    """What the volume finds empty in the open box; it is fitted once, whatever the ground."""
    hull, colors, masks, cameras = hull_of_box()
    fit = volume._fitted

    def fitted_once(rays: object, space: object, steps: int, seed: int, later: object) -> object:
        if seed not in VOLUMES:
            VOLUMES[seed] = fit(rays, space, steps, seed, later)
        return VOLUMES[seed]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(volume, "_fitted", fitted_once)
        patch.setattr(volume, "RAYS", 2048)
        grid = (hull.cells, hull.ticks, hull.ball.center)
        return hollow_cells(*grid, cameras, colors, masks, ground, steps=400, seed=0)


SCENES = {
    "box": open_box(),
    "ball": Scene((Sphere((0.0, 0.0, 0.0), 0.8, waves),), gradient_sky),
    "plain": Scene((Sphere((0.0, 0.0, 0.0), 0.8, constant(0.4, 0.3, 0.2)),), gradient_sky),
}


@cache
def maps_of(name: str, views: int, size: int) -> tuple[list[Camera], list[SurfaceMap]]:
    """Cameras round a scene, none from far below, and what they see."""
    cameras = [c for c in orbit(views, size=size, focal=170 / 128 * size) if c.center[2] > -1]
    return cameras, [SCENES[name].surface_map(camera) for camera in cameras]


@cache
def hull_of(
    name: str, pictures: str = "true", cells: int = 48, views: int = 90, size: int = 128
) -> Seen:
    """The scene's visual hull and its photos; "noise": photos that agree on nothing."""
    cameras, maps = maps_of(name, views, size)
    masks = [torch.from_numpy(m.alpha) for m in maps]
    if pictures == "noise":
        rng = torch.Generator().manual_seed(0)
        blobs = (torch.rand(1, 3, 6, 6, generator=rng) for _ in maps)
        colors = [
            torch.nn.functional.interpolate(blob, (size, size), mode="bicubic")[0].clamp(0, 1)
            for blob in blobs
        ]
        return hull_of(name, "true", cells, views, size)[0], colors, masks, cameras
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial, "HULL_CELLS", cells)
        hull = initial.visual_hull(Ball(np.zeros(3), 1.3), cameras, [m.alpha for m in maps])
    assert hull is not None
    colors = [torch.from_numpy(m.color).permute(2, 0, 1).contiguous() for m in maps]
    return hull, colors, masks, cameras


def test_the_pit_of_an_open_box_is_found_and_its_walls_stay() -> None:
    hull, colors, masks, cameras = hull_of("box", **FINE)
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    sideways, margin = np.maximum(np.abs(x), np.abs(y)), 1.5 * hull.cell
    pit = (sideways < HALF - THICK - margin) & (z > -DEPTH / 2 + margin) & hull.cells
    solid = hull.cells & ((sideways > HALF - THICK + margin) | (z < -DEPTH / 2 - margin))
    assert pit.sum() > 5_000  # silhouettes cannot see it
    assert empty[pit].mean() > 0.6
    assert empty[solid].mean() < 0.01


def test_photos_that_agree_on_nothing_open_nothing() -> None:
    hull, colors, masks, cameras = hull_of("box", "noise", **FINE)
    assert empty_cells(hull.cells, hull.axes(), cameras, colors, masks).mean() < 1e-3


def test_a_convex_matte_body_stays_whole() -> None:
    hull, colors, masks, cameras = hull_of("ball", cells=96)  # a smaller one loses 1.3 %
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    assert empty.sum() < 0.01 * hull.cells.sum()


def test_a_plain_body_stays_whole() -> None:
    hull, colors, masks, cameras = hull_of("plain", **FINE)
    empty = empty_cells(hull.cells, hull.axes(), cameras, colors, masks)
    assert empty.sum() < 0.01 * hull.cells.sum()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_photos_open_nothing(count: int) -> None:
    hull, colors, masks, cameras = hull_of_box()
    few = (cameras[:count], colors[:count], masks[:count])
    assert not empty_cells(hull.cells, hull.axes(), *few).any()
    grid = (hull.cells, hull.ticks, hull.ball.center)
    assert not hollow_cells(*grid, *few, steps=40, seed=0).any()


def test_the_boundary_of_a_cube_is_its_outer_layer() -> None:
    cells = np.zeros((7, 7, 7), bool)
    cells[1:6, 1:6, 1:6] = True
    assert boundary(cells).sum() == 5**3 - 3**3
    assert boundary(np.ones((3, 3, 3), bool)).sum() == 26


def test_the_volume_shows_the_pit_of_an_open_box_and_keeps_its_walls() -> None:
    hull, *_ = hull_of_box()
    empty = hollows_of_box()
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    sideways, margin = np.maximum(np.abs(x), np.abs(y)), 1.5 * hull.cell
    pit = (sideways < HALF - THICK - margin) & (z > -DEPTH / 2 + margin) & hull.cells
    solid = hull.cells & ((sideways > HALF - THICK + margin) | (z < -DEPTH / 2 - margin))
    inner = solid & (sideways < HALF - margin)
    assert empty[pit].mean() > 0.6
    assert empty[inner].mean() < 0.03
    assert not (empty & ~hull.cells).any()


def test_photos_that_agree_on_nothing_show_the_volume_no_hollows() -> None:
    hull, colors, masks, cameras = hull_of("box", "noise")
    empty = hollow_cells(
        hull.cells, hull.ticks, hull.ball.center, cameras, colors, masks, steps=60, seed=0
    )
    assert empty[hull.cells].mean() < 0.02


@pytest.mark.slow
def test_a_volume_that_only_imitates_the_photos_it_learned_opens_nothing() -> None:
    hull, colors, masks, cameras = hull_of("box", "noise")
    some = [list(part)[::5] for part in (cameras, colors, masks)]
    empty = hollow_cells(hull.cells, hull.ticks, hull.ball.center, *some, steps=400, seed=0)
    assert empty[hull.cells].mean() < 0.02


def test_plain_cells_go_with_the_pattern_round_them() -> None:
    """Figures of (photos, explained, better, contrast) for cells of a cube."""
    index = torch.from_numpy(np.argwhere(np.ones((24, 24, 24), bool)))
    told = torch.zeros(4, len(index))
    told[:2] = 20.0
    left = index[:, 0] < 12
    told[2:, left] = 20 * 0.5  # a pattern, but for a plain patch in its middle
    patch = ((index - torch.tensor([5, 12, 12])).abs() <= 1).all(1)
    told[2:, patch] = 0
    better, contrast = _around(told, index, (24, 24, 24))
    assert float(better[patch].min()) > 0.3
    assert float(better[index[:, 0] > 22].max()) < 0.05
    assert torch.equal(better, contrast)
    told[:, ~left] = 0  # no photo looks through these: they count for nothing
    better, _ = _around(told, index, (24, 24, 24))
    assert float(better[index[:, 0] == 11].mean()) == pytest.approx(0.5, abs=0.02)


def test_what_photos_agree_on_at_the_ground_opens_nothing() -> None:
    hull, colors, masks, cameras = hull_of_box()
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    ground = z < -DEPTH / 2 + 2 * hull.cell  # the pit's bottom as the ground, mirrored in the walls
    pit = (np.maximum(np.abs(x), np.abs(y)) < HALF - THICK) & (z > -DEPTH / 2) & hull.cells
    photos = (cameras, colors, masks)
    found = empty_cells(hull.cells, hull.axes(), *photos)
    higher = empty_cells(hull.cells, hull.axes(), *photos, ground)
    assert higher[pit].mean() < 0.3 * found[pit].mean()
    assert hollows_of_box(ground)[pit].mean() < 0.5 * hollows_of_box()[pit].mean()


def test_the_search_can_be_stopped_and_tells_its_progress() -> None:
    hull, colors, masks, cameras = hull_of_box()
    told = []

    def progress(done: int, total: int) -> None:
        told.append((done, total))
        if done == 20:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        hollow_cells(
            hull.cells,
            hull.ticks,
            hull.ball.center,
            cameras,
            colors,
            masks,
            steps=40,
            seed=0,
            progress=progress,
        )
    assert told == [(10, 40), (20, 40)]


def test_what_the_masks_need_comes_back() -> None:
    hull, _, masks, cameras = hull_of_box()
    x, _, z = np.meshgrid(*hull.axes(), indexing="ij")
    corner = hull.cells & (x > HALF - 0.2) & (z > 0)  # seen against the background
    left = hull.cells & ~corner
    needed = needed_by_masks(hull.cells, left, hull.axes(), cameras, masks)
    assert not (needed & ~corner).any()
    assert needed[corner].mean() > 0.5
    again = needed_by_masks(hull.cells, left | needed, hull.axes(), cameras, masks)
    assert again.sum() < 0.02 * corner.sum()


def test_holes_that_nothing_reaches_are_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    hull, colors, masks, cameras = hull_of_box()
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    bubble = (x - HALF) ** 2 + y**2 + (z + DEPTH / 2) ** 2 < 0.05**2
    bubble &= x < HALF - hull.cell * 1.5

    def found(cells: np.ndarray, *_: object) -> np.ndarray:
        return cells & bubble

    monkeypatch.setattr(initial, "empty_cells", found)
    kept = initial.carved(hull, cameras, [torch.as_tensor(c) for c in colors], masks)
    np.testing.assert_array_equal(kept.cells, hull.cells)
