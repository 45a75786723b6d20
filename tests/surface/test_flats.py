"""Flat parts are made flat, and only these."""

import numpy as np
import open3d as o3d
import pytest
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.surface.flats import flats_of, flattened

F64 = NDArray[np.float64]
HALF = np.array([0.4, 0.3, 0.5])
LIMIT, DIAMETER = 0.02, 2.0


def mesh_of(shape: o3d.geometry.TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        np.asarray(shape.vertices, np.float32), np.asarray(shape.triangles, np.int32)
    )


def box(fineness: int = 5) -> TriangleMesh:
    """A box of 12 * 4 ** fineness triangles with its middle at 0."""
    shape = o3d.geometry.TriangleMesh.create_box(*(2 * HALF)).subdivide_midpoint(fineness)
    return mesh_of(shape.translate(-HALF))


def on_edges(mesh: TriangleMesh) -> F64:
    """(V,) outlines that hold a vertex of the box: three near its edges, none elsewhere."""
    gap = np.sort(HALF - np.abs(mesh.vertices), axis=1)
    return np.where(gap[:, 1] < 0.08, 3.0, 0.0)


def bulged(mesh: TriangleMesh, height: float) -> TriangleMesh:
    """The box with its walls bent outwards (or inwards) between its edges, smoothly."""
    points = mesh.vertices.astype(float)
    share = np.abs(points) / HALF
    out = points.copy()
    for axis in range(3):
        on = share[:, axis] > 0.999
        across = np.prod(np.cos(np.pi / 2 * np.delete(share[on], axis, 1)), axis=1)
        out[on, axis] += np.sign(points[on, axis]) * height * across
    return TriangleMesh(out.astype(np.float32), mesh.faces)


def off_walls(mesh: TriangleMesh) -> F64:
    """(V,) how far each vertex lies from the box's surface."""
    gap = np.abs(mesh.vertices) - HALF
    return np.asarray(np.abs(gap).min(1))


@pytest.mark.parametrize("height", [0.02, -0.02])
def test_walls_between_edges_that_outlines_hold_become_planes(height: float) -> None:
    true = box()
    mesh = bulged(true, height)
    told = np.zeros(len(mesh.vertices))
    flats = flats_of(mesh, on_edges(true), told, limit=LIMIT, diameter=DIAMETER)
    done = flattened(mesh, flats)
    assert len(flats) == 6
    assert off_walls(mesh).max() > 0.019
    assert off_walls(done).max() < 0.006  # outlines hold places that bulge by up to 0.008
    assert np.array_equal(done.faces, mesh.faces)


@pytest.mark.parametrize("fineness", [5, 6])
def test_a_few_held_places_all_round_are_enough_on_any_mesh(fineness: int) -> None:
    mesh = bulged(box(fineness), 0.02)
    gap = np.sort(HALF - np.abs(box(fineness).vertices), axis=1)[:, 1]
    ring = (gap > 0.03) & (gap < 0.03 + 0.8 / 2**fineness)  # about one row of vertices
    held = np.where(ring & (np.random.default_rng(3).random(len(gap)) < 0.2), 3.0, 0.0)
    told = np.zeros(len(held))
    assert len(flats_of(mesh, held, told, limit=LIMIT, diameter=DIAMETER)) == 6
    held[mesh.vertices[:, 0] > -0.3] = 0  # one side only: the plane may turn about it
    found = flats_of(mesh, held, told, limit=LIMIT, diameter=DIAMETER)
    assert all(abs(flat.normal[0]) > 0.9 for flat in found)


def test_outlines_bound_the_plane_from_outside() -> None:
    true = box()
    held = np.ones(len(true.vertices))
    top = true.vertices[:, 2] > HALF[2] - 1e-6
    rng = np.random.default_rng(0)
    points = true.vertices.copy()
    points[top, 2] += np.where(rng.random(top.sum()) < 0.4, 0.006, 0.0).astype(np.float32)
    mesh = TriangleMesh(points, true.faces)
    flats = flats_of(mesh, held, 0 * held, limit=LIMIT, diameter=DIAMETER)
    upper = next(flat for flat in flats if flat.normal[2] > 0.9)
    assert abs(upper.center[2] - HALF[2]) < 0.0012  # the mean is 0.0024 too high


@pytest.mark.parametrize("share, is_flat", [(1.0, True), (0.2, False)])
def test_print_holds_a_plain_face_that_no_outline_shows(share: float, is_flat: bool) -> None:
    """Like a clock's face: marks near its border, nothing inside."""
    true = box()
    mesh, none = bulged(true, 0.02), np.zeros(len(true.vertices))
    told = np.where(on_edges(true) > 0, 0.5, 0.0)
    told[true.vertices[:, 0] < (1 - 2 * share) * HALF[0]] = 0  # marks on one side do not hold it
    told[np.abs(true.vertices[:, 0]) > HALF[0] - 1e-6] = 0  # none on the walls that face x
    flats = flats_of(mesh, none, told, limit=LIMIT, diameter=DIAMETER)
    assert len(flats) == (4 if is_flat else 0)
    if is_flat:
        walls = np.abs(true.vertices[:, 1:]) > HALF[1:] - 1e-6
        rows = walls.any(1) & (np.abs(true.vertices[:, 0]) < HALF[0] - 0.1)
        assert off_walls(mesh)[rows].max() > 0.019
        assert off_walls(flattened(mesh, flats))[rows].max() < 0.006


def test_what_colours_or_no_outlines_tell_of_stays() -> None:
    true = box()
    mesh, held = bulged(true, 0.02), on_edges(true)
    none, all_of_it = np.zeros(len(held)), np.ones(len(held))
    assert not flats_of(mesh, held, all_of_it, limit=LIMIT, diameter=DIAMETER)
    assert not flats_of(mesh, none, none, limit=LIMIT, diameter=DIAMETER)
    assert flattened(mesh, []) is mesh


def test_round_bodies_stay_round() -> None:
    ball = mesh_of(o3d.geometry.TriangleMesh.create_sphere(0.5, 60))
    tube = mesh_of(o3d.geometry.TriangleMesh.create_cylinder(0.4, 0.9, 150, 60))
    for mesh in (ball, tube):
        held = np.full(len(mesh.vertices), 3.0)
        flats = flats_of(mesh, held, 0 * held, limit=LIMIT, diameter=DIAMETER)
        assert all(abs(flat.normal[2]) > 0.99 for flat in flats)  # at most the tube's two ends
        assert flattened(mesh, flats).vertices == pytest.approx(mesh.vertices, abs=2e-3)
