"""The mesh of a field's own views: it is the scene's, and its failures are those of a mesh."""

from collections.abc import Iterable

import numpy as np
import pytest
from finished import model
from scenes import glossy_pair

from refdgs_pipe.camera import Camera
from refdgs_pipe.child_process import ChildCrashed
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface import own
from refdgs_pipe.surface.settings import ShapeParams


def quietly(cameras: list[Camera], label: str) -> Iterable[Camera]:
    return cameras


def test_a_program_that_crashes_is_a_mesh_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(*_: object, **__: object) -> None:
        raise ChildCrashed("signal 11")

    monkeypatch.setattr(own, "clean", crash)
    with pytest.raises(MeshError, match=r"could not be cleaned.*signal 11"):
        own.own_surface(model(), glossy_pair().surface_map, None, ShapeParams(), quietly)


def test_the_mesh_is_the_scenes_surface() -> None:
    found = own.own_surface(model(), glossy_pair().surface_map, None, ShapeParams(), quietly)
    distance = np.abs(glossy_pair().distance(found.vertices.astype(np.float64)))
    assert np.median(distance) < 0.01
    assert np.quantile(distance, 0.95) < 0.05
