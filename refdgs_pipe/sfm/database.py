"""COLMAP's database: photos, features and matches. Runs in the child process only."""

from itertools import combinations
from pathlib import Path

import pycolmap

from refdgs_pipe.sfm.poses import Effort, OnProgress, Shots

SEED = 0
PHOTOS_A_STEP = 4  # times the threads: between steps there is progress
PAIRS_A_STEP = 250  # each step indexes its photos' features anew
EXHAUSTIVE_UP_TO = 150  # photos; above it neighbours in name order are matched first
OVERLAP = 10  # neighbours that a photo of a long series is matched with
WITHOUT_EXIF = 1.2  # focal length by the long side, COLMAP's own guess
LENS = "SIMPLE_RADIAL"  # one focal length, one distortion: more run away on the first pair
FAINT = 0.5  # of COLMAP's own threshold of contrast


def register(database: Path, shots: tuple[Shots, ...]) -> None:
    """Write cameras and images first: during extraction ids would depend on which thread wins."""
    with pycolmap.Database.open(database) as db:
        for group in shots:
            focal = group.focal or WITHOUT_EXIF * max(group.width, group.height)
            camera = pycolmap.Camera.create_from_model_name(
                pycolmap.INVALID_CAMERA_ID, LENS, focal, group.width, group.height
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


def extract(
    database: Path,
    images: Path,
    masks: Path | None,
    effort: Effort,
    progress: OnProgress,
    files: list[str],
) -> None:
    """Find features in all photos; `first_octave` of the effort is set.

    Args:
        masks: folder of NAME.png.png, black where features are ignored.
    """
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = effort.max_side
    options.num_threads = effort.threads
    options.use_gpu = False
    options.sift.first_octave = effort.first_octave
    options.sift.max_num_features = effort.max_features
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = effort.affine
    if effort.faint:
        options.sift.peak_threshold *= FAINT
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


def match(database: Path, files: list[str], effort: Effort, progress: OnProgress) -> None:
    """All pairs of a small set; of a large one neighbours, and every tenth photo with its like."""
    if len(files) <= EXHAUSTIVE_UP_TO:
        pairs = list(combinations(files, 2))
    else:
        near = [(a, b) for i, a in enumerate(files) for b in files[i + 1 : i + 1 + OVERLAP]]
        pairs = sorted({*near, *combinations(files[::OVERLAP], 2)})
    match_pairs(database, pairs, effort, progress)


def match_pairs(
    database: Path, pairs: list[tuple[str, str]], effort: Effort, progress: OnProgress
) -> None:
    """Match the features of these pairs and verify the matches."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = effort.threads
    matching.use_gpu = False
    matching.guided_matching = effort.affine
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_name("pairs.txt")
    step = max(PAIRS_A_STEP, len(pairs) // 30)
    for start in range(0, len(pairs), step):
        progress("matching pairs", start, len(pairs))
        _write_pairs(pairing.match_list_path, pairs[start : start + step])
        pycolmap.match_image_pairs(
            database_path=database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=_verification(),
            device=pycolmap.Device.cpu,
        )


def verify_again(database: Path, pairs: list[tuple[str, str]], progress: OnProgress) -> None:
    """Find the motion between the photos of each pair from the matches in the database."""
    listed = database.with_name("pairs.txt")
    for start in range(0, len(pairs), PAIRS_A_STEP):
        progress("verifying pairs", start, len(pairs))
        _write_pairs(listed, pairs[start : start + PAIRS_A_STEP])
        pycolmap.verify_matches(database, listed, _verification())


def _verification() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def _write_pairs(path: Path, pairs: list[tuple[str, str]]) -> None:
    path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
