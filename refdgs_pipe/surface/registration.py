"""Fit a mesh to its views: to their outlines, and to where they agree on its colours."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.mirrored import Glimpse
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.agreement import Pattern, disagreement
from refdgs_pipe.surface.flats import Mirrored, flats_of, flattened
from refdgs_pipe.surface.rims import fit_rims
from refdgs_pipe.surface.silhouettes import MOST, Outline, outline_pull, spread_evenly
from refdgs_pipe.surface.walls import with_walls

F64 = NDArray[np.float64]

_LONGEST = 640  # pixels: more do not make an outline much sharper
_COVERED = 0.5  # alpha
_LIMIT = 0.01  # diameters of the object ball: what lies further off is another part's
# (a table that was removed still covers what is behind the object)
_BLUR = (1.5, 1.0)  # pixels, in the first round and then: further, then finer


@dataclass(frozen=True)
class Fit:
    """A mesh that was fitted to its views.

    Args:
        held: (V,) views on whose outline a vertex lies.
        told: (V,) how much the views' colours tell of its depth, in the same unit.
    """

    mesh: TriangleMesh
    held: F64
    told: F64


def fitted(
    mesh: TriangleMesh,
    model: SparseModel,
    draw: Callable[[Camera], SurfaceMap],
    *,
    rounds: int,
    faces: int,
    flatten: bool = True,
    ground: F64 | None = None,
    track: Callable[[list[Camera], str], Iterable[Camera]],
) -> tuple[Mesh, int]:
    """The mesh fitted to what training cameras see of the object, with walls below its rims.

    Args:
        draw: what a camera sees.
        faces: the most that the mesh may have with its walls.
        flatten: whether flat parts whose depth only outlines tell become planes.
        ground: (3,) unit normal of the ground through the world's origin, if it is known.
        track: wraps the cameras, to report progress under a label.

    Returns:
        The mesh, and how many parts of it were made flat.
    """
    if not rounds:
        return Mesh(mesh.vertices, mesh.faces), 0
    cameras = model.training_cameras
    limit = _LIMIT * 2 * model.ball.radius
    outlines, patterns, glimpses = [], [], []
    for camera in track(cameras, "looking at outlines"):
        framed = camera.framed(model.ball.center, model.ball.radius)
        view = draw(framed.fitted(_LONGEST))
        outlines.append(Outline.of(view.camera, view.alpha >= _COVERED))
        patterns.append(Pattern(view, near=limit))
        glimpses.append(Glimpse.of(view))
    fit = fit_views(mesh, outlines, patterns, limit=limit, rounds=rounds)
    diameter = 2 * model.ball.radius
    flats = []
    if flatten:
        flats = flats_of(
            fit.mesh,
            fit.held,
            fit.told,
            limit=limit,
            diameter=diameter,
            mirrored=Mirrored(glimpses, model.ball.center, ground),
        )
    moved = flattened(fit.mesh, flats)
    moved = with_walls(moved, outlines, limit=limit, faces=faces)
    return Mesh(moved.vertices, moved.faces), len(flats)


def fit_views(
    mesh: TriangleMesh,
    outlines: Sequence[Outline],
    patterns: Sequence[Pattern],
    *,
    limit: float,
    rounds: int,
) -> Fit:
    """The mesh with its vertices moved along their normals, and its open rims where they end.

    Args:
        limit: what lies further off than this is another part's, world units.
        rounds: times that the views are looked at and the vertices moved.
    """
    links = links_of(mesh.faces)
    held, colours = (np.zeros(len(mesh.vertices)) for _ in range(2))
    for number in range(rounds):
        normals = mesh.vertex_normals()
        solid = Solid(mesh.vertices, mesh.faces)
        blur = _BLUR[min(number, len(_BLUR) - 1)]
        told = [
            outline_pull(mesh, normals, solid, outlines, limit=limit),
            disagreement(mesh, normals, solid, patterns, near=limit, blur=blur),
        ]
        weight, pull = np.zeros(len(normals)), np.zeros(len(normals))
        for known, total in told:
            trust = np.minimum(known, MOST)
            weight += trust
            pull += trust * np.clip(total / np.maximum(known, 1e-6), -limit, limit)
        moved = spread_evenly(weight, pull, links)
        points = mesh.vertices + moved[:, None] * normals
        mesh = TriangleMesh(points.astype(np.float32), mesh.faces)
        mesh = fit_rims(mesh, outlines, limit=limit)
        held, colours = told[0][0], told[1][0]
    return Fit(mesh, held, colours)
