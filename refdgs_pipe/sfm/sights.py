"""Sparse points for photos whose poses came with the capture. Runs in the child process only."""

import shutil
from collections import defaultdict
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, whose zlib would break cv2's PNG writer
import numpy as np
import pycolmap

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.sfm import database as base
from refdgs_pipe.sfm.evidence import arrays_of
from refdgs_pipe.sfm.poses import Effort, OnProgress, Posed, Shots

LENS = "FULL_OPENCV"  # holds every lens that can come with a capture


def triangulate(
    images: Path, posed: tuple[Posed, ...], effort: Effort, scratch: Path, progress: OnProgress
) -> Poses:
    """Match the photos' features and triangulate them; poses and lenses stay as they are.

    Args:
        effort: with a number as its `first_octave`.
        scratch: a folder for the database; what is in it is replaced.

    Returns:
        The poses, with the points that they and the features agree on, and no evidence.
    """
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(base.SEED)
    shutil.rmtree(scratch, ignore_errors=True)
    (scratch / "model").mkdir(parents=True)
    scratch = scratch.resolve()
    database = scratch / "database.db"
    shots, by_file = _shots(posed), {photo.file: photo for photo in posed}
    files = sorted(by_file)
    base.register(database, shots)
    model = _model(database, by_file)
    base.extract(database, images, None, effort, progress, files)
    base.match(database, files, effort, progress)
    progress("triangulating points", 0, None)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = base.SEED
    options.triangulation.random_seed = base.SEED
    found = pycolmap.triangulate_points(
        model, database, images, scratch / "model", clear_points=True, options=options
    )
    return arrays_of(found, "given")


def _shots(posed: tuple[Posed, ...]) -> tuple[Shots, ...]:
    """Photos through one lens share a camera."""
    groups: dict[tuple[object, ...], list[Posed]] = defaultdict(list)
    for photo in posed:
        groups[photo.width, photo.height, *photo.lens].append(photo)
    out = []
    for first, *rest in groups.values():
        files = tuple(photo.file for photo in (first, *rest))
        out.append(Shots(files, first.width, first.height, float(np.mean(first.lens[:2]))))
    return tuple(out)


def _model(database: Path, by_file: dict[str, Posed]) -> pycolmap.Reconstruction:
    """The known cameras as a reconstruction without points, with the database's ids.

    The database gets their lenses.
    """
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for image in db.read_all_images():
            photo = by_file[image.name]
            if not model.exists_camera(image.camera_id):
                camera = pycolmap.Camera(
                    model=LENS,
                    width=photo.width,
                    height=photo.height,
                    params=list(photo.lens),
                    camera_id=image.camera_id,
                )
                camera.has_prior_focal_length = True
                db.update_camera(camera)
                model.add_camera_with_trivial_rig(camera)
            own = pycolmap.Image(
                name=image.name, image_id=image.image_id, camera_id=image.camera_id
            )
            pose = pycolmap.Rigid3d(np.asarray(photo.cam_from_world[:3], np.float64))
            model.add_image_with_trivial_frame(own, pose)
    return model
