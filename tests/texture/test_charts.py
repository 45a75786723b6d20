"""Every mesh gets an atlas without overlaps, whatever program fails on it."""

import sys
from collections.abc import Callable

import numpy as np
import pytest
from solids import joined, sphere

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh
from refdgs_pipe.child import ChildCrashed, ChildTimeout, call_in_child
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture import charts


def ball() -> Mesh:
    solid = sphere(24)
    return Mesh(solid.vertices, solid.faces)


def check(result: charts.Unwrapped, mesh: Mesh) -> None:
    uv = result.mesh
    assert uv.uv.min() >= 0 and uv.uv.max() <= 1
    assert result.layout.overlap < 0.002 and result.layout.mirrored < 0.01
    corners = uv.vertices[uv.faces]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces])
    # Seam copies of a vertex share its normal: no visible seam in the shading.
    _, first, same = np.unique(uv.vertices, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(uv.normals, uv.normals[first][same.reshape(-1)])
    assert ((uv.normals * uv.vertices).sum(1) > 0.99).all()


def test_uvatlas_unwraps_a_sphere_with_little_stretch() -> None:
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    check(result, mesh)
    assert result.layout.method == "UVAtlas" and result.refused == ()
    assert result.layout.charts < 20 and result.layout.used > 0.35
    assert result.layout.stretch < 1.3


def test_xatlas_steps_in_when_uvatlas_crashes(monkeypatch: pytest.MonkeyPatch) -> None:
    call = charts.call_in_child

    def failing(target: str, *args: object, **options: object) -> object:
        if "uvatlas" in target:
            raise ChildCrashed(f"{target} crashed (SIGSEGV)")
        return call(target, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(charts, "call_in_child", failing)
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    check(result, mesh)
    assert result.layout.method == "xatlas" and len(result.refused) == 2
    assert "SIGSEGV" in result.refused[0]


def test_face_by_face_is_the_last_resort(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(target: str, *args: object, **options: object) -> object:
        raise ChildTimeout(f"{target} did not finish in 1 s and was stopped")

    monkeypatch.setattr(charts, "call_in_child", late)
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=1)
    assert result.layout.method == "face by face" and len(result.refused) == 3
    assert result.layout.overlap == 0 and result.mesh.uv.max() <= 1
    assert len(result.mesh.vertices) == 3 * len(mesh.faces)


def test_overlapping_charts_are_refused() -> None:
    corners = np.array([[[0, 0], [0, 1], [1, 0]]] * 2, np.float32)
    mesh = TriangleMesh(
        np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]], np.float32),
        np.array([[0, 1, 2], [0, 1, 3]], np.int32),
    )
    assert charts.measure("test", mesh, corners).overlap > 0.9


def test_a_mirrored_atlas_is_turned_over() -> None:
    mirrored = np.array([[[0, 0], [1, 0], [0, 1]]], np.float32)
    turned = charts.unmirrored(mirrored)
    assert turned.tolist() == [[[0, 1], [1, 1], [0, 0]]]
    assert charts.unmirrored(turned).tolist() == turned.tolist()


def test_a_mesh_without_faces_is_refused() -> None:
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    with pytest.raises(MeshError, match="no faces to unwrap"):
        charts.unwrap(empty, gutter=0.01, max_stretch=0.1, timeout_s=1)


def test_holes_and_handles_are_counted() -> None:
    solid = sphere(12)
    assert charts.holes_and_handles(solid) == 0
    punctured = TriangleMesh(solid.vertices, np.delete(solid.faces, [50, 150, 250], axis=0))
    assert charts.holes_and_handles(punctured) == 3


def test_a_mesh_full_of_holes_is_unwrapped_in_parts() -> None:
    solid = sphere(40)
    far_apart = np.arange(100, 6000, 61)
    mesh = Mesh(solid.vertices, np.delete(solid.faces, far_apart, axis=0))
    assert charts.holes_and_handles(mesh) > 60
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    assert result.layout.method == "UVAtlas in parts" and result.refused == ()


@pytest.mark.skipif(sys.platform != "linux", reason="UVAtlas draws lots elsewhere")
@pytest.mark.parametrize("partitions", [1, 4])
def test_an_atlas_is_the_same_every_time(partitions: int) -> None:
    mesh = ball()
    made = [
        call_in_child(
            "refdgs_pipe.texture.charts:uvatlas_corners",
            {
                "vertices": mesh.vertices,
                "faces": mesh.faces,
                "gutter": 4 / 1024,
                "max_stretch": 0.1667,
                "partitions": partitions,
            },
            timeout_s=120,
        )
        for _ in range(2)
    ]
    np.testing.assert_array_equal(*made)


def with_fin(mesh: TriangleMesh) -> Mesh:
    """A third face on an edge."""
    tip = mesh.vertices[mesh.faces[100, :1]] * np.float32(1.5)
    fin = np.array([[*mesh.faces[100, :2], len(mesh.vertices)]], np.int32)
    return Mesh(np.concatenate([mesh.vertices, tip]), np.concatenate([mesh.faces, fin]))


def with_flat_face(mesh: TriangleMesh) -> Mesh:
    a, b, _ = mesh.faces[50]
    return Mesh(mesh.vertices, np.concatenate([mesh.faces, np.array([[a, b, b]], np.int32)]))


def two_pieces(mesh: TriangleMesh) -> Mesh:
    both = joined(mesh, TriangleMesh(mesh.vertices * 0.3 + np.float32(3), mesh.faces))
    return Mesh(both.vertices, both.faces)


@pytest.mark.parametrize("spoilt", [with_fin, with_flat_face, two_pieces])
def test_a_bad_mesh_still_gets_an_atlas_from_some_program(
    spoilt: Callable[[TriangleMesh], Mesh],
) -> None:
    mesh = spoilt(sphere(16))
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    assert result.layout.overlap < 0.002 and np.isfinite(result.mesh.uv).all()
    corners = result.mesh.vertices[result.mesh.faces]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces])
    assert result.refused == () or spoilt is with_flat_face


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_nowhere_are_named(value: float) -> None:
    mesh = ball()
    mesh.vertices[7, 1] = value
    with pytest.raises(MeshError, match="not finite, the first is number 7"):
        charts.unwrap(mesh, gutter=0.01, max_stretch=0.1, timeout_s=60)


def test_faces_of_vertices_that_are_not_there_are_refused() -> None:
    mesh = ball()
    mesh.faces[3, 1] = 10**6
    with pytest.raises(MeshError, match="names vertex 1000000 of"):
        charts.unwrap(mesh, gutter=0.01, max_stretch=0.1, timeout_s=60)


@pytest.mark.slow
def test_a_million_faces_end_in_time_with_some_atlas() -> None:
    solid = sphere(500)
    mesh = Mesh(solid.vertices, solid.faces)
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=2)
    assert result.layout.method == "face by face" and len(result.refused) == 3
