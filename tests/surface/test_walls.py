"""The wall of a plate that fusion lost stands again below its rim, where the views see it."""

import numpy as np
from scenes import look_at
from solids import sphere

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.rims import rim_of
from refdgs_pipe.surface.silhouettes import Outline
from refdgs_pipe.surface.walls import with_walls

AROUND, HEIGHT = 120, 0.05
PIXEL = 0.02
LIMIT = 0.04


def disc(radius: float = 1.0) -> TriangleMesh:
    """A flat disc at z = 0 that looks up."""
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rings = [radius * part * ring for part in (0.3, 0.6, 0.9, 1.0)]
    number = 1 + np.arange(AROUND)
    after = np.roll(number, -1)
    faces = [np.stack([0 * number, number, after], -1)]
    for i in range(3):
        a, b, c, d = (v + (i + j) * AROUND for j in (0, 1) for v in (number, after))
        faces += [np.stack([a, c, d], -1), np.stack([a, d, b], -1)]
    points = np.concatenate([np.zeros((1, 3)), *rings])
    return TriangleMesh(points.astype(np.float32), np.concatenate(faces).astype(np.int32))


def coin() -> TriangleMesh:
    """The same with a wall: what the views see."""
    flat = disc()
    low = flat.vertices[-AROUND:] - np.float32([0, 0, HEIGHT])
    first = len(flat.vertices)
    top, below = first - AROUND + np.arange(AROUND), first + np.arange(AROUND)
    beside, beneath = np.roll(top, -1), np.roll(below, -1)
    wall = [np.stack([top, below, beneath], -1), np.stack([top, beneath, beside], -1)]
    return TriangleMesh(
        np.concatenate([flat.vertices, low]), np.concatenate([flat.faces, *wall]).astype(np.int32)
    )


def cameras() -> list[Camera]:
    """From above and from aslant, all round."""
    found = []
    for i in range(18):
        turn, lift = 2.4 * i, 0.15 + 1.2 * (i % 6) / 6
        eye = 4 * np.array([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)])
        found.append(look_at(f"v{i}", eye, size=160, focal=200))
    return found


def outlines(mesh: TriangleMesh) -> list[Outline]:
    solid = Solid(mesh.vertices, mesh.faces)
    return [Outline.of_mesh(camera, solid) for camera in cameras()]


def test_a_wall_that_views_see_stands_below_the_rim() -> None:
    flat = disc()
    mesh = with_walls(flat, outlines(coin()), limit=LIMIT, faces=5000)
    assert len(mesh.faces) == len(flat.faces) + 2 * AROUND
    low = mesh.vertices[rim_of(mesh).vertices]
    assert abs(np.median(low[:, 2]) + HEIGHT) < PIXEL / 2
    assert abs(np.linalg.norm(low[:, :2], axis=1).mean() - 1) < PIXEL / 3
    a, b, c = (mesh.vertices[mesh.faces[len(flat.faces) :, i]] for i in range(3))
    outwards = (np.cross(b - a, c - a) * (a + b + c))[:, :2].sum(1)
    assert (outwards > 0).all()


def test_a_rim_that_lies_too_far_out_comes_back_when_it_gets_its_wall() -> None:
    mesh = with_walls(disc(1.02), outlines(coin()), limit=LIMIT, faces=5000)
    reach = np.linalg.norm(mesh.vertices[rim_of(mesh).vertices, :2], axis=1)
    assert abs(reach.mean() - 1) < PIXEL / 3


def test_a_sheet_without_a_wall_gets_none() -> None:
    flat = disc()
    assert with_walls(flat, outlines(flat), limit=LIMIT, faces=5000) is flat


def test_walls_keep_to_the_budget_of_faces() -> None:
    flat = disc()
    most = len(flat.faces) + 2 * AROUND - 1
    assert with_walls(flat, outlines(coin()), limit=LIMIT, faces=most) is flat


def test_a_closed_mesh_has_no_rim_to_stand_a_wall_on() -> None:
    ball = sphere(16)
    assert with_walls(ball, outlines(coin()), limit=LIMIT, faces=10**6) is ball


def test_a_torn_rim_gets_no_wall() -> None:
    torn = disc()
    torn.vertices[-AROUND:, 2] += np.random.default_rng(0).uniform(-0.1, 0.1, AROUND)
    assert with_walls(torn, outlines(coin()), limit=LIMIT, faces=5000) is torn
