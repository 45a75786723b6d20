"""Poses from structure from motion become a sparse model in the world frame of photos."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.camera import F64, Camera, Lens, center_of
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.geometry import one_sided
from refdgs_pipe.sfm.ball import grown_ball, object_ball
from refdgs_pipe.sfm.frame import moved, world_from_sfm
from refdgs_pipe.sfm.poses import Shots
from refdgs_pipe.sfm.support import level_up, off_planes, support_plane
from refdgs_pipe.vectors import unit

PARALLEL_DEG = 0.5  # between the rays of photos, below which they tell no point's place


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
            the points that fewer than two others see, or that these see in one direction.
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
    """The points that two of these photos or more see from different directions.

    A photo that was put far away can hold points there, at which the others look in parallel. With
    that photo the points go. Where every photo is kept, all points are.
    """
    tracks = {file: poses.tracks[file] for file in kept}
    if len(kept) == len(poses.cam_from_world):
        return poses.points, poses.colors, tracks
    times = np.zeros(len(poses.points), np.int64)
    first = np.zeros((len(poses.points), 3))
    apart = np.zeros(len(poses.points), bool)
    for file, track in tracks.items():
        rays = unit(poses.points[track] - center_of(poses.cam_from_world[file]))
        again = times[track] > 0
        apart[track] |= again & ((rays * first[track]).sum(1) < np.cos(np.radians(PARALLEL_DEG)))
        first[track] = np.where(again[:, None], first[track], rays)
        times[track] += 1
    index = np.cumsum(apart) - 1
    tracks = {file: index[track[apart[track]]] for file, track in tracks.items()}
    return poses.points[apart], poses.colors[apart], tracks


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
