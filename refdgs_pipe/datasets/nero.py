"""NeRO's GlossySynthetic as published: 7.png, 7-depth.png and 7-camera.pkl for every view."""

from pathlib import Path

import numpy as np

from refdgs_pipe.artifacts.capture import Frame, Layout, named_frames, nero_depth
from refdgs_pipe.artifacts.views import KnownPose, Skipped
from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.datasets.poses import Size, check_shape, commonest, rigid
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.images import read_header
from refdgs_pipe.files.pickled_arrays import read_pickled_arrays


def read_nero(layout: Layout) -> tuple[list[Frame], list[Skipped]]:
    """Every photo that has a camera, masked by its depth, and what is missing.

    A photo without depth is left out unless none has any: then nothing is masked.

    Raises:
        CorruptError: a camera's pickle is damaged, or holds anything but two arrays.
        InputError: what it holds is no camera.
    """
    cameras = {path.name.removesuffix("-camera.pkl"): path for path in layout.model}
    photos = {photo.stem: photo for photo in layout.photos}
    masked = any(nero_depth(photo).is_file() for photo in layout.photos)
    sizes, skipped = _sizes(layout.photos)
    usual = commonest(list(sizes.values()))
    frames = []
    for number, path in cameras.items():
        photo = photos.get(number)
        if photo is None:
            skipped.append(Skipped(f"{number}.png", f"{path.name} is there, but not the photo"))
        elif photo in sizes and usual is not None:
            try:
                frames.append(_frame(photo, path, sizes[photo], usual, masked=masked))
            except CaptureError as error:
                skipped.append(Skipped(photo.name, str(error)))
    for number, photo in photos.items():
        if number not in cameras:
            skipped.append(Skipped(photo.name, f"{number}-camera.pkl is not there"))
    return named_frames(layout.root, frames), skipped


def _sizes(photos: tuple[Path, ...]) -> tuple[dict[Path, Size], list[Skipped]]:
    """Width and height of every photo whose header can be read."""
    sizes: dict[Path, Size] = {}
    skipped = []
    for photo in photos:
        try:
            header = read_header(photo)
            sizes[photo] = (header.width, header.height)
        except CaptureError as error:
            skipped.append(Skipped(photo.name, str(error)))
    return sizes, skipped


def _frame(photo: Path, camera: Path, size: Size, usual: Size, *, masked: bool) -> Frame:
    check_shape(size, usual, whose="most others are")
    depth = nero_depth(photo)
    if masked and not depth.is_file():
        raise CaptureError(f"{depth.name} is not there, and it is what masks the photo")
    return Frame(
        photo,
        mask=depth if masked else None,
        mask_kind="depth",
        known=_camera(camera, width=size[0], height=size[1]),
    )


def _camera(path: Path, *, width: float, height: float) -> KnownPose:
    """The OpenCV camera (cam_from_world 3 x 4, K 3 x 3) of a pickle."""
    arrays = read_pickled_arrays(path)
    shapes = [array.shape for array in arrays]
    if shapes != [(3, 4), (3, 3)]:
        raise InputError(
            f"{path}: holds arrays of shapes {shapes}, expected [(3, 4), (3, 3)]: world-to-camera "
            "and K. Copy it again from where it came from"
        )
    pose, K = arrays
    return KnownPose(Lens(_checked_K(path, K, width, height), np.zeros(8)), rigid(str(path), pose))


def _checked_K(path: Path, K: F64, width: float, height: float) -> F64:
    upright = np.array_equal(K[2], [0, 0, 1]) and K[1, 0] == 0 and K[0, 1] == 0
    if not (np.isfinite(K).all() and upright and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(
            f"{path}: K is {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        )
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height):
        raise InputError(
            f"{path}: K's principal point ({K[0, 2]:g}, {K[1, 2]:g}) lies outside the photo of "
            f"{width:g} x {height:g} pixels. Use the photos at the size of their cameras"
        )
    return K
