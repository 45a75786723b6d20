"""Poses from structure from motion become a sparse model in the world frame of photos."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.camera import F64, Camera, Lens
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.geometry import one_sided
from refdgs_pipe.sfm.ball import grown_ball, object_ball
from refdgs_pipe.sfm.frame import moved, world_from_sfm
from refdgs_pipe.sfm.poses import Shots
from refdgs_pipe.sfm.support import level_up, off_planes, support_plane


def shots_of(views: Views, sizes: Mapping[str, tuple[int, int]]) -> tuple[Shots, ...]:
    """Group the photos by camera, lens, focal length and size: each group shares its intrinsics.

    Args:
        sizes: name of a view -> width and height in pixels of the picture that is placed.
    """
    groups: dict[tuple[object, ...], list[View]] = defaultdict(list)
    for view in views.items:
        exif = view.exif
        zoom = None if exif.focal_mm is None else round(exif.focal_mm, 1)
        key = (exif.make, exif.model, exif.lens, zoom, *sizes[view.name])
        groups[key].append(view)
    shots = []
    for first, *rest in groups.values():
        files = tuple(f"{view.name}.png" for view in (first, *rest))
        width, height = sizes[first.name]
        share = first.exif.focal_fraction
        focal = None if share is None else share * max(width, height)
        shots.append(Shots(files, width, height, focal))
    return tuple(shots)


def model_from_poses(
    views: Views, poses: Poses, lost: Mapping[str, str], *, up: F64 | None = None
) -> SparseModel:
    """Bring the poses into the world frame: z up, the object on the origin, its ball the unit.

    Args:
        lost: file name -> why it has no trusted place; these photos are left out, and with them
            the points that fewer than two others see.
        up: (3,) unit vector in the frame of the poses, where something told it.
    """
    by_file = {f"{view.name}.png": view for view in views.items}
    kept = [file for file in poses.cam_from_world if file not in lost]
    cameras, lens_of = [], {}
    for file in kept:
        view = by_file[file]
        name, width, height, params = poses.lenses[poses.lens_of[file]]
        K, distortion = opencv_lens(name, params)
        scale = np.diag([view.width / width, view.height / height, 1.0])
        lens_of[view.name] = lens = Lens(scale @ K, distortion)
        pose = poses.cam_from_world[file]
        cameras.append(Camera(view.name, view.width, view.height, lens.K, pose, view.split))
    cameras.sort(key=lambda camera: camera.name)
    points, colors, tracks = _seen_points(poses, kept)
    model = SparseModel(
        cameras=tuple(cameras),
        lenses=lens_of,
        points=points,
        point_colors=colors,
        tracks={by_file[file].name: track for file, track in tracks.items()},
        ball=Ball(np.zeros(3), 1.0),
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=tuple(Lost(by_file[file].name, why) for file, why in lost.items()),
    )
    return in_world_frame(model, views, up=up)


def _seen_points(
    poses: Poses, kept: list[str]
) -> tuple[F64, NDArray[np.uint8], dict[str, NDArray[np.int64]]]:
    """The points that two of these photos or more see; all of them where every photo is kept."""
    tracks = {file: poses.tracks[file] for file in kept}
    if len(kept) == len(poses.cam_from_world):
        return poses.points, poses.colors, tracks
    times = np.zeros(len(poses.points), np.int64)
    for track in tracks.values():
        times[track] += 1
    index = np.cumsum(times >= 2) - 1
    tracks = {file: index[track[times[track] >= 2]] for file, track in tracks.items()}
    return poses.points[times >= 2], poses.colors[times >= 2], tracks


def in_world_frame(model: SparseModel, views: Views, *, up: F64 | None = None) -> SparseModel:
    """Find up, support and ball, and move everything so that they are z, the origin and 1.

    Args:
        up: (3,) unit vector where something told it, such as the printed mat.
    """
    told = up is not None
    up = level_up(model.cameras) if up is None else up
    ball = object_ball(model.cameras, views)
    if views.background == "photo":
        solid = off_planes(model.points, ball.center, ball.radius)
        one_side = one_sided(model.cameras, ball.center, up)
        ball = grown_ball(ball, solid, one_sided=one_side)
    plane = support_plane(model.points, ball.center, ball.radius, up)
    up = up if plane is None or told else plane.normal
    front = model.cameras[0].center
    world = world_from_sfm(ball, up, plane, model.points, front)
    return moved(replace(model, ball=ball, up=up), world)
