"""Poses from structure from motion become a sparse model in the world frame of photos."""

from collections import defaultdict
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.errors import PoseError
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.sfm.ball import grown_ball, object_ball
from refdgs_pipe.sfm.frame import moved, world_from_sfm
from refdgs_pipe.sfm.poses import Poses, Shots
from refdgs_pipe.sfm.support import level_up, off_planes, support_plane

NAMES_SHOWN = 8


def shots_of(views: Views) -> tuple[Shots, ...]:
    """Group the photos by camera, lens, focal length and size: each group shares its intrinsics."""
    groups: dict[tuple[object, ...], list[View]] = defaultdict(list)
    for view in views.items:
        exif = view.exif
        zoom = None if exif.focal_mm is None else round(exif.focal_mm, 1)
        key = (exif.make, exif.model, exif.lens, zoom, view.width, view.height)
        groups[key].append(view)
    shots = []
    for first, *rest in groups.values():
        files = tuple(PurePath(view.file).name for view in (first, *rest))
        share = first.exif.focal_fraction
        focal = None if share is None else share * max(first.width, first.height)
        shots.append(Shots(files, first.width, first.height, focal))
    return tuple(shots)


def check_registered(views: Views, poses: Poses | None, *, least: float) -> Poses:
    """Refuse a model that would give a poor object.

    Args:
        least: share of the photos that must have found their place.

    Raises:
        PoseError: fewer did; names the lost photos and what to do.
    """
    placed = set() if poses is None else {PurePath(f).stem for f in poses.cam_from_world}
    lost = [view.source for view in views.items if view.name not in placed]
    total = len(views.items)
    if poses is not None and len(placed) >= max(3, least * total):
        return poses
    names = ", ".join(lost[:NAMES_SHOWN])
    more = f" and {len(lost) - NAMES_SHOWN} more" if len(lost) > NAMES_SHOWN else ""
    raise PoseError(
        f"only {len(placed)} of {total} photos found their place, {least:.0%} are needed. "
        f"Without a place: {names}{more}. Take more photos between these and the others, each "
        "sharing half of its picture with the next, with a textured ground (newspaper) in sight; "
        "or lower sfm.min_registered"
    )


def model_from_poses(views: Views, poses: Poses) -> SparseModel:
    """Bring the poses into the world frame: z up, the object on the origin, its ball the unit."""
    lenses = [Lens(*opencv_lens(name, params)) for name, _, _, params in poses.lenses]
    by_file = {PurePath(view.file).name: view for view in views.items}
    cameras, lens_of, tracks = [], {}, {}
    for file, pose in poses.cam_from_world.items():
        view = by_file[file]
        lens = lens_of[view.name] = lenses[poses.lens_of[file]]
        cameras.append(Camera(view.name, view.width, view.height, lens.K, pose, view.split))
        tracks[view.name] = poses.tracks[file]
    cameras.sort(key=lambda camera: camera.name)
    lost = [view for view in views.items if view.name not in lens_of]
    model = SparseModel(
        cameras=tuple(cameras),
        lenses=lens_of,
        points=poses.points,
        point_colors=poses.colors,
        tracks=tracks,
        ball=Ball(np.zeros(3), 1.0),
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=tuple(Lost(view.name, "shares too few features with the others") for view in lost),
    )
    return in_world_frame(model, views)


def in_world_frame(model: SparseModel, views: Views) -> SparseModel:
    """Find up, support and ball, and move everything so that they are z, the origin and 1."""
    up = level_up(model.cameras)
    ball = object_ball(model.cameras, views)
    if views.background == "photo":
        ball = grown_ball(ball, off_planes(model.points, ball.center, ball.radius))
    plane = support_plane(model.points, ball.center, ball.radius, up)
    up = up if plane is None else plane.normal
    front = model.cameras[0].center
    world = world_from_sfm(ball, up, plane, model.points, front)
    return moved(replace(model, ball=ball, up=up), world)
