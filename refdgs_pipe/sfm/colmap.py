"""Structure from motion with pycolmap, to be run in a process of its own: it can abort.

The photos lie as PNGs in one folder, upright; what EXIF says of the focal length comes as `Shots`.
Equal inputs give equal poses: ids follow the names, mapping runs on one thread and is seeded.
"""

import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, whose zlib would break cv2's PNG writer
import numpy as np
import pycolmap

from refdgs_pipe.sfm.poses import Effort, OnProgress, Poses, Shots

SEED = 0
PHOTOS_A_STEP = 4  # times the threads: between steps there is progress
PAIRS_A_STEP = 250  # each step indexes its photos' features anew
DOUBLED_UP_TO = 1000  # px
EXHAUSTIVE_UP_TO = 150  # photos; above it neighbours in name order are matched first
GLOBAL_BELOW = 0.9  # share registered under which the global mapper is tried too
PHOTOS_FOR_OPENCV = 16  # with fewer its eight parameters are not well determined
OVERLAP = 10  # neighbours that a photo of a long series is matched with
WITHOUT_EXIF = 1.2  # focal length by the long side, COLMAP's own guess


def reconstruct(
    images: Path,
    shots: tuple[Shots, ...],
    masks: Path | None,
    effort: Effort,
    scratch: Path,
    progress: OnProgress,
) -> Poses | None:
    """Pose as many of the photos as possible; None if there is no start at all.

    Args:
        masks: folder of NAME.png.png, black where features are ignored.
        scratch: a folder for the database and the models; what is in it is replaced.
    """
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(SEED)
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    scratch = scratch.resolve()
    database = scratch / "database.db"
    files = sorted(file for group in shots for file in group.files)
    _register(database, shots)
    doubled = max(max(group.width, group.height) for group in shots) <= DOUBLED_UP_TO
    octave = effort.first_octave if effort.first_octave is not None else -int(doubled)
    effort = replace(effort, first_octave=octave)
    _extract(database, images, masks, effort, progress, files)
    _match(database, files, effort, progress)
    best = _incremental(database, images, scratch / "incremental", progress, len(files))
    lost = set(files) - _names(best)
    if lost and best is not None and len(files) > EXHAUSTIVE_UP_TO:
        pairs = [(a, b) for a in sorted(lost) for b in files if a != b]
        _match_pairs(database, pairs, effort, progress)
        again = _incremental(database, images, scratch / "again", progress, len(files))
        best = again if _size(again) > _size(best) else best
    if _size(best)[0] < GLOBAL_BELOW * len(files):
        progress("solving all poses at once", 0, None)
        other = _global(database, images, scratch / "global")
        if _size(other)[0] > _size(best)[0]:
            return _poses(other, "global")
    return _poses(best, "incremental")


def _register(database: Path, shots: tuple[Shots, ...]) -> None:
    """Write cameras and images first: during extraction ids would depend on which thread wins."""
    with pycolmap.Database.open(database) as db:
        for group in shots:
            focal = group.focal or WITHOUT_EXIF * max(group.width, group.height)
            model = "OPENCV" if len(group.files) >= PHOTOS_FOR_OPENCV else "SIMPLE_RADIAL"
            camera = pycolmap.Camera.create_from_model_name(
                pycolmap.INVALID_CAMERA_ID, model, focal, group.width, group.height
            )
            camera.has_prior_focal_length = group.focal is not None
            camera.camera_id = db.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            rig_id = db.write_rig(rig)
            for file in group.files:
                image = pycolmap.Image(name=file, camera_id=camera.camera_id)
                image.image_id = db.write_image(image)
                frame = pycolmap.Frame(rig_id=rig_id)
                frame.add_data_id(image.data_id)
                db.write_frame(frame)


def _extract(
    database: Path,
    images: Path,
    masks: Path | None,
    effort: Effort,
    progress: OnProgress,
    files: list[str],
) -> None:
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = effort.max_side
    options.num_threads = effort.threads
    options.use_gpu = False
    options.sift.first_octave = effort.first_octave
    options.sift.max_num_features = effort.max_features
    step = PHOTOS_A_STEP * effort.threads
    for start in range(0, len(files), step):
        progress("finding features", start, len(files))
        pycolmap.extract_features(
            database_path=database,
            image_path=images,
            image_names=files[start : start + step],
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )


def _match(database: Path, files: list[str], effort: Effort, progress: OnProgress) -> None:
    """All pairs of a small set; of a large one neighbours, and every tenth photo with its like."""
    if len(files) <= EXHAUSTIVE_UP_TO:
        pairs = list(combinations(files, 2))
    else:
        near = [(a, b) for i, a in enumerate(files) for b in files[i + 1 : i + 1 + OVERLAP]]
        pairs = sorted({*near, *combinations(files[::OVERLAP], 2)})
    _match_pairs(database, pairs, effort, progress)


def _match_pairs(
    database: Path, pairs: list[tuple[str, str]], effort: Effort, progress: OnProgress
) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = effort.threads
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_name("pairs.txt")
    step = max(PAIRS_A_STEP, len(pairs) // 30)
    for start in range(0, len(pairs), step):
        progress("matching pairs", start, len(pairs))
        lines = [f"{a} {b}\n" for a, b in pairs[start : start + step]]
        pairing.match_list_path.write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(
            database_path=database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def _incremental(
    database: Path, images: Path, folder: Path, progress: OnProgress, total: int
) -> Any:
    """The largest reconstruction, or None."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = 3
    options.random_seed = SEED
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    placed = [0]

    def count(step: int) -> None:
        placed[0] += step
        progress("placing photos", min(placed[0], total), total)

    folder.mkdir()
    found = pycolmap.incremental_mapping(
        database_path=database,
        image_path=images,
        output_path=folder,
        options=options,
        initial_image_pair_callback=lambda: count(2),
        next_image_callback=lambda: count(1),
    )
    return max(found.values(), key=_size, default=None)


def _global(database: Path, images: Path, folder: Path) -> Any:
    """The largest reconstruction of the global mapper, which edits its database; or None."""
    folder.mkdir()
    copy = folder / "database.db"
    shutil.copyfile(database, copy)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = SEED
    found = pycolmap.global_mapping(
        database_path=copy, image_path=images, output_path=folder, options=options
    )
    return max(found.values(), key=_size, default=None)


def _size(model: Any) -> tuple[int, int]:
    """How much was reconstructed: photos first, then points."""
    return (0, 0) if model is None else (model.num_reg_images(), model.num_points3D())


def _names(model: Any) -> set[str]:
    ids = [] if model is None else model.reg_image_ids()
    return {model.image(i).name for i in ids}


def _poses(model: Any, mapper: str) -> Poses | None:
    if model is None:
        return None
    point_ids = sorted(model.point3D_ids())
    index = {point_id: i for i, point_id in enumerate(point_ids)}
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    camera_ids = sorted({image.camera_id for image in images})
    lenses = []
    for camera in (model.camera(i) for i in camera_ids):
        params = np.array(camera.params, float)
        lenses.append((str(camera.model.name), camera.width, camera.height, params))
    poses, tracks = {}, {}
    for image in images:
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        poses[image.name] = pose
        seen = {index[p.point3D_id] for p in image.points2D if p.has_point3D()}
        tracks[image.name] = np.array(sorted(seen), np.int64)
    points = [model.point3D(i) for i in point_ids]
    return Poses(
        cam_from_world=poses,
        lens_of={image.name: camera_ids.index(image.camera_id) for image in images},
        lenses=tuple(lenses),
        points=np.array([point.xyz for point in points], float).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        tracks=tracks,
        error_px=float(model.compute_mean_reprojection_error()),
        mapper=mapper,
    )
