"""Cleaning leaves one sound surface within its budget, and says what it took away."""

import numpy as np
import pytest
from solids import joined, sphere, volume

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.cleanup import clean, without_floaters
from refdgs_pipe.surface.topology import compacted, defects, pieces


def test_a_noisy_punctured_sphere_with_floaters_becomes_a_clean_one() -> None:
    random = np.random.default_rng(0)
    body = sphere(80)
    noisy = body.vertices * (1 + 0.003 * random.normal(size=(len(body.vertices), 1)))
    holed = np.delete(body.faces, np.arange(400, 406), axis=0)
    floaters = [sphere(5, radius=0.03, center=(1.3, 0.1 * i, 0)) for i in range(4)]
    raw = joined(TriangleMesh(noisy.astype(np.float32), holed), *floaters)
    result = clean(raw, floater=0.16, hole=0.5, smoothing=10, faces=4000)
    mesh = result.mesh
    assert not defects(mesh).any and pieces(mesh).max() == 0
    assert len(mesh.faces) <= 4000 and result.rims == []
    assert result.removed.pieces == 4 and 0 < result.removed.area_share < 0.01
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - 1).mean() < 0.003 and volume(mesh) > 4.1


def test_a_large_hole_stays_open_and_is_reported() -> None:
    body = sphere(30)
    top = body.vertices[body.faces].mean(1)[:, 2] > 0.7
    result = clean(
        compacted(body.vertices, body.faces[~top]), floater=0.1, hole=0.3, smoothing=0, faces=10**6
    )
    assert len(result.rims) == 1 and result.rims[0].length > 4
    assert len(result.mesh.faces) == (~top).sum()


def test_only_floaters_still_leaves_the_largest() -> None:
    small, smaller = sphere(6, radius=0.02), sphere(6, radius=0.01, center=(1, 0, 0))
    kept, removed = without_floaters(joined(smaller, small), 1.0)
    assert len(kept.faces) == len(small.faces) and removed.pieces == 1
    assert np.abs(kept.vertices).max() < 0.03


def test_a_mesh_without_area_is_refused() -> None:
    flat = TriangleMesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(MeshError, match="no face with an area"):
        without_floaters(flat, 0.1)
