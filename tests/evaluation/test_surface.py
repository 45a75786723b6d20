"""Meshes whose distance is known beforehand."""

from dataclasses import replace

import numpy as np
import pytest
import solids
from scenes import look_at, orbit

from refdgs_pipe.artifacts.mesh import TriangleMesh, UvMesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.evaluation.surface import Surface, sampled, score_surface

FROM_ABOVE = [
    look_at(f"v{i}", np.array([x, y, 3.0]), size=200, focal=220.0)
    for i, (x, y) in enumerate([(0.1, 0.2), (1, -0.5), (-0.8, 1)])
]


def plane(half: float = 1.0, z: float = 0.0, cells: int = 20) -> TriangleMesh:
    """A square that faces up."""
    axis = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3).astype(np.float32)
    at = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return TriangleMesh(vertices, faces.astype(np.int32))


def moved(mesh: TriangleMesh, *by: float) -> TriangleMesh:
    return TriangleMesh((mesh.vertices + np.array(by)).astype(np.float32), mesh.faces)


def all_round() -> list[Camera]:
    return orbit(16, size=160, focal=200.0)


def test_the_truth_itself_is_perfect_in_both_protocols() -> None:
    ball = solids.sphere(48)
    score = score_surface(ball, all_round(), ball)
    assert score is not None
    assert score.paper_chamfer == 0
    assert score.chamfer is not None and score.chamfer < 1e-6
    assert score.f_score_half_percent == score.f_score_one_percent == 1
    assert score.diagonal == pytest.approx(2 * 3**0.5, rel=1e-3)


def test_a_plane_shifted_along_its_normal_is_that_far_off() -> None:
    truth = plane()
    diagonal = 2 * 2**0.5
    score = score_surface(moved(truth, 0, 0, 0.01 * diagonal), FROM_ABOVE, truth)
    assert score is not None and score.diagonal == pytest.approx(diagonal)
    assert score.chamfer == pytest.approx(0.01 * diagonal, abs=1e-6)
    assert score.percent(score.chamfer) == pytest.approx(1, abs=1e-4)
    assert score.percent(score.accuracy) == pytest.approx(1, abs=1e-4)
    assert score.f_score_half_percent == 0
    # points are at most a voxel from their match in the plane: sqrt(0.0283^2 + 0.005^2) or so
    assert score.paper_chamfer == pytest.approx(0.01 * diagonal, rel=0.05)


def test_a_ball_shifted_by_one_percent_is_half_of_that_off() -> None:
    """The mean of |cos| over a sphere is 1/2; cameras all round see all of it."""
    truth = solids.sphere(96)
    up_and_down = [look_at(f"p{z}", np.array([0.01, 0, z]), size=160) for z in (-4.0, 4.0)]
    step = 0.01 * 2 * 3**0.5
    score = score_surface(moved(truth, step, 0, 0), [*all_round(), *up_and_down], truth)
    assert score is not None
    assert score.chamfer == pytest.approx(step / 2, rel=0.03)  # facets and the poles' small rim
    assert score.f_score_one_percent == 1


def test_what_no_camera_sees_does_not_count() -> None:
    """A floor below the true plane: hidden, but far from the truth."""
    truth = plane()
    score = score_surface(solids.joined(truth, plane(0.3, z=-0.5)), FROM_ABOVE, truth)
    assert score is not None
    assert score.chamfer == pytest.approx(0, abs=1e-6)
    assert score.paper_chamfer == 0


def test_a_hole_costs_completeness_and_not_accuracy() -> None:
    truth = plane()
    half = TriangleMesh(truth.vertices, truth.faces[truth.vertices[truth.faces, 0].max(1) <= 1e-6])
    score = score_surface(half, FROM_ABOVE, truth)
    assert score is not None and score.completeness is not None
    assert score.accuracy == pytest.approx(0, abs=1e-6)
    assert score.completeness == pytest.approx(0.25, rel=0.02)  # half of it, 0.5 away on average


def test_a_dent_shows_in_the_worst_part() -> None:
    truth = plane(cells=80)
    dented = truth.vertices.copy()
    inside = np.abs(dented[:, :2] - 0.5).max(1) < 0.2
    dented[inside, 2] = -0.1
    score = score_surface(TriangleMesh(dented, truth.faces), FROM_ABOVE, truth)
    assert score is not None and score.chamfer is not None
    assert score.chamfer < 0.006
    assert score.worst_accuracy == pytest.approx(0.1, rel=0.35)
    assert score.worst_completeness == pytest.approx(0.1, rel=0.35)
    assert score.median_accuracy == pytest.approx(0, abs=1e-6)


def test_only_points_give_only_the_papers_figure() -> None:
    truth = plane()
    points = Surface(truth, FROM_ABOVE).seen_points(0.01)
    score = score_surface(truth, FROM_ABOVE, None, points)
    assert score is not None and score.paper_chamfer == 0
    assert score.chamfer is None


def test_nothing_in_sight_gives_no_score() -> None:
    assert score_surface(moved(plane(), 0, 0, 100), FROM_ABOVE, plane()) is None
    flat = TriangleMesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    assert score_surface(flat, FROM_ABOVE, plane()) is None


def test_points_are_averaged_in_voxels_of_a_grid_that_stands_still() -> None:
    points = Surface(plane(z=0.05), FROM_ABOVE).seen_points(0.1)
    cells = np.floor(points / 0.1)
    assert len(np.unique(cells, axis=0)) == len(points)  # one each
    assert len(points) == 400


def test_samples_are_even_and_repeatable() -> None:
    mesh = solids.joined(plane(1.0), plane(0.5, z=1.0))
    points = sampled(mesh, 10_000, 0)
    assert (points[:, 2] > 0.5).mean() == pytest.approx(0.2, abs=1e-3)
    assert np.abs(points[points[:, 2] < 0.5].mean(0)).max() < 0.02
    assert np.array_equal(points, sampled(mesh, 10_000, 0))


def test_the_order_of_confidence_is_that_of_the_distances() -> None:
    """One half of a plane lies higher; confidence is lower there, or higher."""
    mesh = plane()
    raised = np.where(mesh.vertices[:, :1] > 0, [[0, 0, 0.05]], 0)
    bent = replace(mesh, vertices=(mesh.vertices + raised).astype(np.float32))
    uv = (bent.vertices[:, :2] + 1) / 2
    ranks = []
    for low in ("right", "left"):
        confidence = np.full((64, 64), 60_000, np.uint16)
        confidence[:, 32:] = 20_000
        if low == "left":
            confidence = confidence[:, ::-1].copy()
        score = score_surface(bent, FROM_ABOVE, mesh, textured=painted(bent, uv, confidence))
        assert score is not None and score.confidence_rank is not None
        ranks.append(score.confidence_rank)
    assert ranks[0] > 0.8 and ranks[1] < -0.8


def painted(mesh: TriangleMesh, uv: np.ndarray, confidence: np.ndarray) -> TexturedMesh:
    """A mesh whose textures are plain but for one."""
    plain = np.full_like(confidence, 30_000)
    three = np.repeat(plain[..., None], 3, axis=2)
    cut = UvMesh(mesh.vertices, mesh.vertex_normals(), uv.astype(np.float32), mesh.faces)
    tangents = np.tile(np.float32([1, 0, 0, 1]), (len(mesh.vertices), 1))
    return TexturedMesh(cut, tangents, three, plain, plain, plain, three, confidence)
