"""A COLMAP workspace: images/ and a model with their poses, text or binary.

Ref-Real has it in sparse/0, NeRO's GlossyReal in colmap/sparse/0.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from refdgs_pipe.artifacts.capture import Frame, Layout, relative_name, safe_names
from refdgs_pipe.artifacts.views import KnownPoints, KnownPose, Skipped
from refdgs_pipe.camera import Lens
from refdgs_pipe.datasets.poses import check_shape, rigid
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.colmap import ColmapImage, ColmapModel, opencv_lens, read_model
from refdgs_pipe.files.images import read_header


def read_colmap(layout: Layout) -> tuple[list[Frame], list[Skipped], KnownPoints]:
    """The photos that the model poses, what is missing on either side, and its points.

    Raises:
        CorruptError: the model is damaged.
        InputError: a lens that cannot be undistorted, or a pose that is none.
    """
    folder = layout.model[0].parent
    model = read_model(folder)
    sources = [relative_name(layout.root, path) for path in layout.photos]
    by_source = dict(zip(sources, layout.photos, strict=True))
    names = dict(zip(sources, safe_names(sources), strict=True))
    sound = np.isfinite(model.xyz).all(axis=1)
    number = {int(point): i for i, point in enumerate(model.point_ids[sound])}
    frames, tracks = [], {}
    skipped = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        path = by_source.pop(image.name, None)
        try:
            if path is None:
                raise CaptureError("posed by the model but not in images/")
            header = read_header(path)
            known = _known(folder, model, image, (header.width, header.height))
        except CaptureError as error:
            skipped.append(Skipped(image.name, str(error)))
            continue
        name = names[image.name]
        frames.append(Frame(path, image.name, name, known=known))
        seen = {number[int(i)] for i in image.point_ids if int(i) in number}
        tracks[name] = np.array(sorted(seen), int)
    skipped += [Skipped(source, "the COLMAP model has no pose for it") for source in by_source]
    return frames, skipped, KnownPoints(model.xyz[sound], model.rgb[sound], tracks)


def _known(
    folder: Path, model: ColmapModel, image: ColmapImage, size: tuple[int, int]
) -> KnownPose:
    """The lens in pixels of the file, which may be a reduced copy of what COLMAP saw."""
    where = f"{folder}: {image.name}"
    if image.camera_id not in model.cameras:
        raise InputError(f"{where}: its camera {image.camera_id} is not in the model")
    camera = model.cameras[image.camera_id]
    try:
        K, distortion = opencv_lens(camera.model, camera.params)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    if not (np.isfinite(K).all() and np.isfinite(distortion).all() and min(K[0, 0], K[1, 1]) > 0):
        raise InputError(f"{where}: the lens {camera.params.tolist()} is none. Run COLMAP again")
    check_shape(size, (camera.width, camera.height), whose="its camera in the model is")
    scale = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0])
    pose = np.eye(4)
    if np.isfinite(image.quat).all() and image.quat.any():
        pose[:3, :3] = Rotation.from_quat(image.quat, scalar_first=True).as_matrix()
    else:
        pose[:3, :3] = np.nan
    pose[:3, 3] = image.translation
    return KnownPose(Lens(scale @ K, distortion), rigid(where, pose))
