"""Coarser versions keep the shape, the texture and its place."""

from dataclasses import replace

import numpy as np
import pytest
from painted import textured as painted_ball
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.texture.charts import unwrap
from refdgs_pipe.texture.levels import levels
from refdgs_pipe.texture.tangents import mikktspace
from refdgs_pipe.texture.texels import rasterize


def textured(size: int) -> TexturedMesh:
    """The painted ball, cut into a few charts."""
    solid = sphere(24, center=(0, 0, 1))
    cut = unwrap(Mesh(solid.vertices, solid.faces), gutter=0.02, max_stretch=0.2, timeout_s=60)
    return replace(painted_ball(size), mesh=cut.mesh, tangents=mikktspace(cut.mesh))


def test_levels_keep_to_their_budget_and_say_how_far_they_are() -> None:
    whole = textured(128)
    found = list(levels(whole, (300, 120)))
    sizes = [len(level.textured.mesh.faces) for level in found]
    assert sizes[0] <= 300 and sizes[1] <= 120 and sizes[1] < sizes[0]
    assert 0 < found[0].mean < found[1].mean < 0.1
    assert found[0].mean < found[0].most < 0.4
    for level in found:
        mesh = level.textured.mesh
        away = np.linalg.norm(mesh.vertices - [0, 0, 1], axis=1)
        assert np.abs(away - 1).max() < 0.3
        assert level.textured.base_color is whole.base_color
        assert ((mesh.normals * (mesh.vertices - [0, 0, 1])).sum(1) > 0).all()
        assert len(rasterize(mesh, 128).index) > 1000
    assert "m at most" in found[0].told(0.1)


def test_a_budget_that_the_mesh_keeps_makes_no_level() -> None:
    assert list(levels(textured(64), (10**6,))) == []


@pytest.mark.parametrize("budget", [1])
def test_too_small_a_budget_still_leaves_a_mesh(budget: int) -> None:
    (level,) = levels(textured(64), (budget,))
    assert len(level.textured.mesh.faces) >= 1
