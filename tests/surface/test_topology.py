"""Defects are counted, and the split always ends in a manifold."""

import numpy as np
from solids import joined, sphere, volume

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.surface.topology import (
    Defects,
    compacted,
    defects,
    face_areas,
    made_manifold,
    pieces,
    rims,
)


def test_a_sphere_is_one_sound_piece_without_rims() -> None:
    mesh = sphere()
    assert defects(mesh) == Defects(0, 0, 0, 0)
    assert pieces(mesh).max() == 0 and rims(mesh) == []
    assert abs(face_areas(mesh.vertices, mesh.faces).sum() - 4 * np.pi) < 0.1


def test_a_hole_is_a_rim_of_its_length_and_area() -> None:
    mesh = sphere(40)
    cap = mesh.vertices[mesh.faces].mean(1)[:, 2] > np.cos(np.pi / 4)
    found = rims(TriangleMesh(mesh.vertices, mesh.faces[~cap]))
    radius = np.sin(np.pi / 4)
    assert len(found) == 1
    assert abs(found[0].length - 2 * np.pi * radius) < 0.05
    assert abs(found[0].area - np.pi * radius**2) < 0.05
    assert abs(found[0].center[2] - radius) < 0.03


def test_two_fans_that_touch_in_a_vertex_are_parted() -> None:
    a, b = sphere(6), sphere(6, center=(0, 0, 2))
    both = joined(a, b)
    lower_tip = len(a.vertices) + len(b.vertices) - 1
    faces = both.faces.copy()
    faces[faces == lower_tip] = 0
    touching = compacted(both.vertices, faces)
    assert defects(touching).vertices == 1
    parted = made_manifold(touching)
    assert not defects(parted).any and pieces(parted).max() == 1


def test_a_third_face_on_an_edge_is_parted_or_dropped() -> None:
    mesh = sphere(12)
    corner = mesh.faces[100]
    vertices = np.concatenate([mesh.vertices, 1.5 * mesh.vertices[corner[:1]]])
    fin = np.array([[corner[0], corner[1], len(mesh.vertices)]], np.int32)
    broken = TriangleMesh(vertices, np.concatenate([mesh.faces, fin]))
    assert defects(broken).edges == 1
    fixed = made_manifold(broken)
    assert not defects(fixed).any and len(fixed.faces) >= len(mesh.faces) - 2


def test_random_triangle_soup_becomes_manifold() -> None:
    random = np.random.default_rng(1)
    vertices = random.normal(size=(40, 3)).astype(np.float32)
    faces = random.integers(0, 40, (400, 3)).astype(np.int32)
    assert not defects(made_manifold(TriangleMesh(vertices, faces))).any


def test_orientation_survives_the_split() -> None:
    assert volume(made_manifold(sphere())) > 4.0


def test_degenerate_and_repeated_faces_and_loose_vertices_go() -> None:
    mesh = sphere(8)
    extra = np.array([mesh.faces[3], mesh.faces[3][[1, 2, 0]], [5, 5, 9]], np.int32)
    vertices = np.concatenate([mesh.vertices, [[9, 9, 9]]]).astype(np.float32)
    dirty = TriangleMesh(vertices, np.concatenate([mesh.faces, extra]))
    tidy = compacted(dirty.vertices, dirty.faces)
    assert len(tidy.faces) == len(mesh.faces) and len(tidy.vertices) == len(mesh.vertices)
