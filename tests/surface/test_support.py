"""The table is told from what stands on it, and nothing else is taken for a table."""

import numpy as np
import pytest
from solids import cube_corners, joined, sphere

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.support import Support, above_support, find_support
from refdgs_pipe.surface.topology import compacted, pieces, rims

UP = np.array([0.0, 0.0, 1.0])
SIZE = 2.0
FACES = np.array(
    [
        *([0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]),
    ],
    np.int32,
)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> TriangleMesh:
    """An axis-aligned box, counter-clockwise outside."""
    corners = np.array(low) + cube_corners() * np.subtract(high, low)
    return TriangleMesh(corners.astype(np.float32), FACES)


def table(half: float = 1.0, *, noise: float = 0.002, cells: int = 60) -> TriangleMesh:
    """A noisy level sheet at z = 0."""
    ticks = np.linspace(-half, half, cells + 1)
    x, y = (grid.reshape(-1) for grid in np.meshgrid(ticks, ticks))
    z = np.random.default_rng(0).normal(0, noise, len(x))
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return TriangleMesh(np.stack([x, y, z], 1).astype(np.float32), faces.astype(np.int32))


def upper(mesh: TriangleMesh, low: float) -> TriangleMesh:
    """Only the faces that reach higher, as cameras above see them."""
    return compacted(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces][..., 2].max(1) > low])


CRATE = upper(box((-0.3, -0.2, 0.0), (0.3, 0.2, 0.5)), 0.01)


def found(mesh: TriangleMesh, up: np.ndarray = UP) -> Support:
    support = find_support(mesh, up, SIZE)
    assert support is not None
    return support


def test_a_box_is_cut_from_the_table_and_keeps_its_size() -> None:
    mesh = joined(table(), CRATE)
    support = found(mesh)
    assert support.normal @ UP > 0.9999 and abs(support.offset) < 1e-3
    assert 0.003 * SIZE <= support.margin <= 0.01 * SIZE
    assert support.share == pytest.approx(4 / (4 + 0.24 + 1), abs=0.02)
    kept = above_support(mesh, support)
    np.testing.assert_allclose(kept.vertices.min(0), (-0.3, -0.2, 0), atol=2e-3)
    np.testing.assert_allclose(kept.vertices.max(0), (0.3, 0.2, 0.5), atol=1e-6)
    assert pieces(kept).max() == 0
    (rim,) = rims(kept)  # open where it stood
    assert rim.length == pytest.approx(2.0, abs=0.01) and abs(rim.center[2]) < 2e-3


def test_the_shoulder_of_an_object_without_a_table_is_no_table() -> None:
    shoulder = box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.6))
    knob = box((-0.1, -0.1, 0.6), (0.1, 0.1, 0.85))
    assert find_support(joined(shoulder, knob), UP, SIZE) is None
    support = find_support(joined(table(), upper(knob, 0.61), upper(shoulder, 0.01)), UP, SIZE)
    assert support is not None and abs(support.offset) < 1e-3


def test_the_same_mesh_gives_the_same_plane() -> None:
    mesh = joined(table(noise=0.005), CRATE)
    first, second = found(mesh), found(mesh)
    np.testing.assert_array_equal(first.normal, second.normal)
    assert first == Support(first.normal, second.offset, second.margin, second.bump, second.share)


def test_up_may_point_anywhere_and_lean() -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    mesh = joined(table(), CRATE)
    turned = TriangleMesh((mesh.vertices @ turn.T + 3).astype(np.float32), mesh.faces)
    lean = turn @ np.array([np.sin(0.15), 0, np.cos(0.15)])
    support = found(turned, lean)
    assert support.normal @ (turn @ UP) > 0.9999
    back = (above_support(turned, support).vertices - 3) @ turn
    np.testing.assert_allclose(back.max(0), (0.3, 0.2, 0.5), atol=1e-4)


def test_a_lid_larger_than_the_table_is_no_table() -> None:
    crate = upper(box((-0.9, -0.9, 0.0), (0.9, 0.9, 0.6)), 0.01)
    plate = upper(table(), -1)
    around = np.abs(plate.vertices[plate.faces][..., :2]).max((1, 2)) > 0.9
    support = found(joined(compacted(plate.vertices, plate.faces[around]), crate))
    assert abs(support.offset) < 1e-3 and support.share < 0.2


def test_several_things_stay_and_bumps_of_the_table_go() -> None:
    bump = upper(sphere(12, radius=0.3, center=(0.6, 0.6, -0.27)), -0.05)  # 0.03 high
    ball = sphere(12, radius=0.2, center=(-0.6, -0.6, 0.2))
    mesh = joined(table(noise=0.004), CRATE, bump, ball)
    kept = above_support(mesh, found(mesh))
    assert pieces(kept).max() == 1
    assert kept.vertices[:, :2].max() < 0.31 and kept.vertices[:, :2].min() < -0.79


@pytest.mark.parametrize("alone", ["box", "ball", "bowl", "table"])
def test_what_stands_on_nothing_has_no_support(alone: str) -> None:
    solid = {
        "box": CRATE,
        "ball": sphere(30),
        "table": table(),
        # its bottom is level and has walls standing on it, but they stand around it
        "bowl": joined(
            table(0.5),
            *(
                box((x - 0.02, y - 0.02, -0.1), (x + 0.02, y + 0.02, 0.6))
                for x, y in 0.52 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
            ),
        ),
    }[alone]
    assert find_support(solid, UP, SIZE) is None


def test_a_wall_is_no_table() -> None:
    mesh = joined(table(), CRATE)
    assert find_support(mesh, np.array([1.0, 0, 0]), SIZE) is None


def test_a_plane_with_nothing_above_it_cannot_be_cut_off() -> None:
    with pytest.raises(MeshError, match=r"use clean\.keep=all"):
        above_support(table(), Support(UP, 0.0, 0.02, 0.04, 1.0))
    with pytest.raises(MeshError, match=r"use clean\.keep=all"):
        above_support(table(), Support(UP, 5.0, 0.02, 0.04, 1.0))
