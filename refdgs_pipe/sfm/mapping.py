"""COLMAP's mappers, and the lens refined once enough photos hold it. Child process only."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from refdgs_pipe.sfm.database import SEED

FOCALS = (0.35, 10.0)  # focal lengths that a camera may have, by the long side
MOST_DISTORTION = 0.7  # of any parameter of a lens
FIRST_PAIR = (30, 4.0)  # matches and degrees that the first pair needs, where few are shared
FEWEST = 12  # matches that place a photo there; COLMAP's own: 30
PHOTOS_FOR_OPENCV = 16  # with fewer its eight parameters are not well determined
BETTER = 0.995  # of the reprojection error: a richer lens has to earn its parameters
FOCAL_DRIFT = 1.15  # by which the refined focal length may differ


def incremental(
    database: Path,
    images: Path,
    folder: Path,
    placed: Callable[[int], None],
    *,
    lenient: bool = False,
    start: Any = None,
) -> list[Any]:
    """All reconstructions of the incremental mapper, best first: most photos, then points.

    Args:
        folder: for what it writes; placed: hears how many photos each step placed.
        lenient: for photos that share few features, as on a turntable whose background is left
            out: fewer matches place a photo, points that two photos see count, and the lens keeps
            its distortion, for there is too little to tell it from.
        start: a reconstruction to go on from; None begins anew.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = 3
    options.random_seed = SEED
    options.min_focal_length_ratio, options.max_focal_length_ratio = FOCALS
    options.max_extra_param = MOST_DISTORTION
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    if lenient:
        options.mapper.init_min_num_inliers, options.mapper.init_min_tri_angle = FIRST_PAIR
        options.mapper.abs_pose_min_num_inliers = FEWEST
        options.triangulation.ignore_two_view_tracks = False
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
    given = ""
    if start is not None:
        given = str(folder / "start")
        (folder / "start").mkdir()
        start.write(given)
    found = pycolmap.incremental_mapping(
        input_path=given,
        database_path=database,
        image_path=images,
        output_path=folder,
        options=options,
        initial_image_pair_callback=lambda: placed(2),
        next_image_callback=lambda: placed(1),
    )
    return sorted(found.values(), key=size, reverse=True)


def all_at_once(database: Path, images: Path, folder: Path) -> Any:
    """The largest reconstruction of the global mapper, or None.

    It wants focal lengths first: they are calibrated from the pairs, in a copy of the database.
    """
    folder.mkdir()
    copy = folder / "database.db"
    shutil.copyfile(database, copy)
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = SEED
    pycolmap.calibrate_view_graph(copy, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = SEED
    found = pycolmap.global_mapping(
        database_path=copy, image_path=images, output_path=folder, options=options
    )
    return max(found.values(), key=size, default=None)


def only(model: Any, files: list[str]) -> Any:
    """A copy of the reconstruction in which only these photos have a place.

    Args:
        files: their names; those of the model's other photos are left out with their sights.
    """
    copy = pycolmap.Reconstruction(model)
    for image_id in list(copy.reg_image_ids()):
        image = copy.image(image_id)
        if image.name not in files:
            copy.deregister_frame(image.frame_id)
    return copy


def size(model: Any) -> tuple[int, int]:
    """How much was reconstructed: photos first, then points."""
    return (0, 0) if model is None else (model.num_reg_images(), model.num_points3D())


def refined(model: Any) -> Any:
    """The model with OpenCV's lens for each camera that enough photos hold, if that fits better.

    Mapping starts with one focal length and one distortion. A richer lens is kept only where the
    error falls and its parameters stay near what they were.
    """
    photos: dict[int, int] = {}
    for image_id in model.reg_image_ids():
        camera_id = model.image(image_id).camera_id
        photos[camera_id] = photos.get(camera_id, 0) + 1
    held = [camera_id for camera_id, count in photos.items() if count >= PHOTOS_FOR_OPENCV]
    if not held:
        return model
    richer = pycolmap.Reconstruction(model)
    for camera_id in held:
        camera = richer.camera(camera_id)
        focal, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = np.array([focal, focal, cx, cy, k, 0.0, 0.0, 0.0])
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(richer, options)
    richer.update_point_3d_errors()
    before, after = (m.compute_mean_reprojection_error() for m in (model, richer))
    sane = all(_is_near(model.camera(i).params, richer.camera(i).params) for i in held)
    return richer if sane and after < BETTER * before else model


def _is_near(plain: Any, rich: Any) -> bool:
    """Whether an OPENCV lens stayed near the SIMPLE_RADIAL one that it grew from."""
    focal = float(plain[0])
    fx, fy = float(rich[0]), float(rich[1])
    near = all(1 / FOCAL_DRIFT < f / focal < FOCAL_DRIFT for f in (fx, fy))
    return near and 0.97 < fx / fy < 1.03 and bool(np.abs(rich[4:]).max() < MOST_DISTORTION)
