"""A COLMAP workspace: images/ and a model with their poses, text or binary."""

import numpy as np
from scipy.spatial.transform import Rotation

from refdgs_pipe.artifacts.capture import Frame, Layout, relative_name, safe_names
from refdgs_pipe.artifacts.views import KnownPoints, KnownPose, Skipped
from refdgs_pipe.camera import Lens
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.colmap import ColmapCamera, ColmapImage, opencv_lens, read_model
from refdgs_pipe.files.images import read_header


def read_colmap(layout: Layout) -> tuple[list[Frame], list[Skipped], KnownPoints]:
    """The photos that the model poses, what is missing on either side, and its points.

    Raises:
        CorruptError: the model is damaged.
        InputError: a lens that cannot be undistorted.
    """
    folder = layout.model[0].parent
    model = read_model(folder)
    sources = [relative_name(layout.root, path) for path in layout.photos]
    by_source = dict(zip(sources, layout.photos, strict=True))
    names = dict(zip(sources, safe_names(sources), strict=True))
    number = {int(point): i for i, point in enumerate(model.point_ids)}
    frames, tracks = [], {}
    skipped = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        path = by_source.pop(image.name, None)
        try:
            if path is None:
                raise CaptureError("posed by the model but not in images/")
            header = read_header(path)
        except CaptureError as error:
            skipped.append(Skipped(image.name, str(error)))
            continue
        try:
            camera = model.cameras[image.camera_id]
            known = _known(image, camera, header.width, header.height)
        except (ValueError, KeyError) as error:
            raise InputError(f"{folder}: {image.name}: {error}") from None
        name = names[image.name]
        frames.append(Frame(path, image.name, name, known=known))
        tracks[name] = np.array(sorted({number[int(i)] for i in image.point_ids if i >= 0}), int)
    skipped += [Skipped(source, "the COLMAP model has no pose for it") for source in by_source]
    return frames, skipped, KnownPoints(model.xyz, model.rgb, tracks)


def _known(image: ColmapImage, camera: ColmapCamera, width: int, height: int) -> KnownPose:
    """The lens in pixels of the file, which may be a reduced copy of what COLMAP saw."""
    K, distortion = opencv_lens(camera.model, camera.params)
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(image.quat, scalar_first=True).as_matrix()
    pose[:3, 3] = image.translation
    return KnownPose(Lens(scale @ K, distortion), pose)
