"""Every mesh gets an atlas without overlaps, whatever program fails on it."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solids import sphere, touching_pieces, turned_face, two_pieces, with_fin, with_flat_face

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture import charts
from refdgs_pipe.texture.programs import Program


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
    assert result.layout.method.startswith("UVAtlas") and result.refused == ()
    assert result.layout.charts < 20 and result.layout.worth > 0.4
    assert result.layout.stretch < 1.3


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Lets the named backends run a function of child_targets in the programs' place.

    One that hangs has a second, and the other programs the time that they are given.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "pipeline"))
    run = charts._run

    def hastened(program: Program, *arguments: Any) -> Any:
        *others, timeout_s, stop = arguments
        hangs = program.target == "child_targets:hang"
        return run(program, *others, 1.0 if hangs else timeout_s, stop)

    monkeypatch.setattr(charts, "_run", hastened)

    def spoil(way: str, *backends: str) -> None:
        spoilt = tuple(
            replace(p, target=f"child_targets:{way}") if p.backend in backends else p
            for p in charts.PROGRAMS
        )
        monkeypatch.setattr(charts, "PROGRAMS", spoilt)

    return spoil


@pytest.mark.parametrize(
    ("backend", "way", "told"),
    [
        ("uvatlas", "segfault", "SIGSEGV"),
        ("xatlas", "kill_self", "SIGKILL"),
        ("xatlas", "hang", "did not finish in 1 s"),
    ],
)
def test_the_other_program_steps_in_when_one_dies(
    broken: Callable[..., None], backend: charts.Backend, way: str, told: str
) -> None:
    broken(way, backend)
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60, backend=backend)
    check(result, mesh)
    other = {"uvatlas": "xatlas", "xatlas": "UVAtlas"}[backend]
    assert result.layout.method == other and result.tried == (result.layout,)
    assert len(result.refused) == {"uvatlas": 2, "xatlas": 1}[backend]
    assert all(told in reason for reason in result.refused)


def test_face_by_face_is_the_last_resort(broken: Callable[..., None]) -> None:
    broken("segfault", "uvatlas", "xatlas")
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    assert result.layout.method == "face by face" and len(result.refused) == 3
    assert result.layout.overlap == 0 and result.mesh.uv.max() <= 1
    assert len(result.mesh.vertices) == 3 * len(mesh.faces)


@pytest.mark.parametrize(("backend", "method"), [("uvatlas", "UVAtlas"), ("xatlas", "xatlas")])
def test_a_preferred_program_is_taken_whatever_its_atlas_is_worth(
    monkeypatch: pytest.MonkeyPatch, backend: charts.Backend, method: str
) -> None:
    monkeypatch.setattr(charts, "_GOOD", 2.0)
    mesh = ball()
    result = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=60, backend=backend)
    check(result, mesh)
    assert result.layout.method == method and result.tried == (result.layout,)


def test_of_several_atlases_the_one_that_is_worth_most_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(charts, "_GOOD", 2.0)
    result = charts.unwrap(ball(), gutter=4 / 1024, max_stretch=0.1667, timeout_s=60)
    assert [one.method for one in result.tried] == ["UVAtlas", "UVAtlas in parts", "xatlas"]
    assert result.layout.worth == max(one.worth for one in result.tried)
    assert charts.measure("", ball(), result.mesh.uv[result.mesh.faces]).worth == pytest.approx(
        result.layout.worth, rel=1e-3
    )


def test_worth_falls_with_stretch_and_with_emptiness() -> None:
    square = TriangleMesh(
        np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]], np.float32),
        np.array([[0, 2, 1], [1, 2, 3]], np.int32),
    )
    uv = square.vertices[:, :2] * [1, -1] + [0, 1]

    def worth(scale: tuple[float, float]) -> float:
        corners = (uv * scale)[square.faces].astype(np.float32)
        return charts.measure("test", square, corners).worth

    assert worth((1, 1)) == pytest.approx(1, abs=0.01)
    assert worth((0.5, 0.5)) == pytest.approx(0.25, abs=0.01)
    # Half as wide as high: as sharp as an even atlas of 2 / 5 of the square.
    assert worth((0.5, 1)) == pytest.approx(0.4, abs=0.01)


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
@pytest.mark.parametrize("program", charts.PROGRAMS, ids=lambda program: program.name)
def test_an_atlas_is_the_same_every_time(program: Program) -> None:
    mesh = ball()
    made = [charts._run(program, mesh, 4 / 1024, 0.1667, 120, None) for _ in range(2)]
    np.testing.assert_array_equal(*made)


@pytest.mark.parametrize(
    "spoilt", [with_fin, with_flat_face, two_pieces, touching_pieces, turned_face]
)
def test_a_bad_mesh_still_gets_an_atlas_from_some_program(
    spoilt: Callable[[TriangleMesh], TriangleMesh],
) -> None:
    solid = spoilt(sphere(16))
    mesh = Mesh(solid.vertices, solid.faces)
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
