"""The surface that views of a field agree on, as one mesh."""

import threading
from collections.abc import Callable, Iterable

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.child_process import ChildCrashed, ChildTimeout
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.cleanup import clean
from refdgs_pipe.surface.gaps import without_base
from refdgs_pipe.surface.registration import fitted
from refdgs_pipe.surface.settings import ShapeParams
from refdgs_pipe.surface.tsdf import Volume


def own_surface(
    model: SparseModel,
    draw: Callable[[Camera], SurfaceMap],
    ground: F64 | None,
    p: ShapeParams,
    track: Callable[[list[Camera], str], Iterable[Camera]],
    stop: threading.Event | None = None,
) -> Mesh:
    """Fuse what training cameras see, clean it and fit it to its outlines and colours.

    Args:
        draw: what a camera sees.
        ground: (3,) unit normal of the plane through the origin that closes the object below.
        track: wraps the cameras, to report progress under a label; may raise.

    Raises:
        MeshError: the views show no surface, or the program that cleans it fails.
    """
    cameras = model.training_cameras
    volume = Volume(model.ball, voxel=p.voxel, band=p.band, min_alpha=p.min_alpha, ground=ground)
    for camera in track(cameras, "fusing depth"):
        framed = camera.framed(model.ball.center, model.ball.radius)
        volume.integrate(draw(framed.fitted(p.pixels)))
    diameter = 2 * model.ball.radius
    raw: TriangleMesh = volume.extract(min_views=min(p.min_views, volume.views))
    if ground is not None:
        raw = without_base(raw, ground, diameter)
    try:
        done = clean(
            raw,
            floater=p.floater * diameter,
            hole=p.hole * diameter,
            smoothing=p.smoothing,
            faces=p.faces_before_walls if p.outlines else p.faces,
            stop=stop,
        )
    except (ChildCrashed, ChildTimeout, RuntimeError) as error:
        raise MeshError(f"the mesh could not be cleaned ({error})") from error
    return fitted(
        done.mesh,
        model,
        draw,
        rounds=p.outlines,
        faces=p.faces,
        flatten=p.flatten,
        ground=ground,
        track=track,
    )[0]
