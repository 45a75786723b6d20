"""Poses that came with the capture become a sparse model; features only add points to them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.geometry import one_sided
from refdgs_pipe.sfm.ball import grown_ball, object_ball
from refdgs_pipe.sfm.pictures import plain_images
from refdgs_pipe.sfm.poses import Effort, Posed
from refdgs_pipe.sfm.support import level_up, off_planes

Z_IS_UP_DEG = 40.0


def needs_points(views: Views) -> bool:
    """Whether known poses came without points, and without masks that tell where the object is."""
    return views.background == "photo" and views.points is None


def posed_photos(views: Views, effort: Effort, scratch: Path) -> dict[str, Any]:
    """What `sights.triangulate` needs to know of photos with known poses.

    Args:
        scratch: a folder for pictures and for what the child process writes.
    """
    pictures = plain_images(views, scratch)
    posed = []
    for view in views.items:
        assert view.known is not None
        width, height = pictures.sizes[view.name]
        lens = view.known.lens
        K = np.diag([width / view.width, height / view.height, 1.0]) @ lens.K
        params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.distortion)
        numbers = tuple(float(value) for value in params)
        posed.append(Posed(f"{view.name}.png", width, height, numbers, view.known.cam_from_world))
    return {
        "images": pictures.folder,
        "posed": tuple(posed),
        "effort": effort.for_photos(pictures.sizes),
        "scratch": scratch / "colmap-known",
    }


def without_points(error: Exception) -> str:
    """What to say where features could not be matched; the poses are kept."""
    reason = (str(error) or type(error).__name__).splitlines()[0]  # not the child's whole log
    return (
        f"no points were found for the poses that came with the photos ({reason}): where the "
        "object is follows from the cameras alone. Masks of the object help, or "
        "gate.ball_center and gate.ball_radius"
    )


def model_from_known_poses(views: Views, found: Poses | None = None) -> SparseModel:
    """Keep the capture's own world frame; find the ball and the up axis in it.

    Args:
        found: with the points that were triangulated, where none came with the poses.
    """
    model = _as_given(views)
    if found is None or views.points is not None:
        return model
    named = {Path(file).stem: track for file, track in found.tracks.items()}
    model = replace(model, points=found.points, point_colors=found.colors, tracks=named)
    ball = model.ball
    solid = off_planes(model.points, ball.center, ball.radius)
    one_side = one_sided(model.cameras, ball.center, model.up)
    return replace(model, ball=grown_ball(ball, solid, one_sided=one_side))


def _as_given(views: Views) -> SparseModel:
    cameras = known_cameras(views)
    lenses = {view.name: view.known.lens for view in views.items if view.known is not None}
    points = views.points
    train = tuple(camera for camera in cameras if camera.split == "train") or cameras
    return SparseModel(
        cameras=cameras,
        lenses=lenses,
        points=np.zeros((0, 3)) if points is None else points.xyz,
        point_colors=np.zeros((0, 3), np.uint8) if points is None else points.colors,
        tracks={} if points is None else points.tracks,
        ball=object_ball(train, views),
        up=known_up(train),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def known_cameras(views: Views) -> tuple[Camera, ...]:
    """Distortion-free cameras of the known poses, by name."""
    cameras = [
        Camera(v.name, v.width, v.height, v.known.lens.K, v.known.cam_from_world, v.split)
        for v in views.items
        if v.known is not None
    ]
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def known_up(cameras: tuple[Camera, ...]) -> F64:
    """World z if the photos do not contradict it, else their own mean upward direction."""
    up = level_up(cameras)
    z = np.array([0.0, 0.0, 1.0])
    return z if up[2] > np.cos(np.radians(Z_IS_UP_DEG)) else up
