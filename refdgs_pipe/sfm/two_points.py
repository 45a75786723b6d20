"""The size of a reconstruction from two points whose distance the user measured."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.errors import InputError
from refdgs_pipe.sfm.mat_frame import shown, unbent

HELP = (
    "expected two photos, in each the pixels of the same two points, and the points' distance in "
    "metres, such as: IMG_0003.jpg:812,455 IMG_0003.jpg:1200,460 IMG_0017.jpg:640,300 "
    "IMG_0017.jpg:1012,310 0.23"
)
LEAST_ANGLE = np.radians(3.0)  # between the two rays to a point
MISS = 0.01  # part of the photo's long side that a point may be off by

_MARK = re.compile(r"(.+):(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class TwoPoints:
    """Two points, marked in two photos or more.

    Args:
        marks: photo -> (2, 2) pixels of the first and the second point in the user's file,
            centre of the first pixel at 0.5.
        metres: between them.
    """

    marks: dict[str, F64]
    metres: float


@dataclass(frozen=True)
class Marked:
    """A placed photo with its marks.

    Args:
        cam_from_world: (4, 4), rigid; lens: of the pixels that the marks count.
        width, height: of these pixels.
    """

    lens: Lens
    cam_from_world: F64
    width: int
    height: int


def parsed(text: str) -> TwoPoints:
    """Read what the user wrote: PHOTO:X,Y PHOTO:X,Y for each photo, then metres.

    The first mark of a photo is the first point, the second one the second.

    Raises:
        InputError: not in this form; says what is wrong and shows an example.
    """
    *marks, distance = text.split() or [""]
    try:
        metres = float(distance)
    except ValueError:
        raise InputError(f"distance: {distance!r} is no length in metres; {HELP}") from None
    if not 1e-4 <= metres <= 1e4:
        raise InputError(f"distance: {distance} m: expected 0.0001 to 10000 metres")
    found = []
    for word in marks:
        match = _MARK.fullmatch(word)
        if match is None:
            raise InputError(f"distance: {word!r} is no mark in a photo; {HELP}")
        found.append((match[1], float(match[2]), float(match[3])))
    by_photo = {
        photo: [(x, y) for _, x, y in group]
        for photo, group in groupby(sorted(found, key=lambda m: m[0]), key=lambda m: m[0])
    }
    for photo, points in by_photo.items():
        if len(points) != 2:
            count = f"{len(points)} mark" + ("s" if len(points) > 1 else "")
            raise InputError(f"distance: {photo} has {count}: expected both points; {HELP}")
    if len(by_photo) < 2:
        raise InputError(f"distance: {len(by_photo)} photos are marked: {HELP}")
    return TwoPoints({photo: np.array(points) for photo, points in by_photo.items()}, metres)


def marked_photos(
    model: SparseModel, views: Views, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Marked]:
    """The placed photos under the names of the user's files, in the pixels of these files.

    Args:
        sizes: the user's file -> its width and height, upright; the images of `views` may be
            smaller. Files that are not in it are left out.
    """
    found = {}
    for camera in model.cameras:
        source = views[camera.name].source
        if source in sizes:
            width, height = sizes[source]
            lens = model.lenses[camera.name]
            larger = np.diag([width / camera.width, height / camera.height, 1.0])
            scaled = Lens(larger @ lens.K, lens.distortion)
            found[source] = Marked(scaled, camera.cam_from_world, width, height)
    return found


def metres_per_unit(points: TwoPoints, photos: Mapping[str, Marked]) -> float:
    """How many metres a unit of the reconstruction is.

    Args:
        photos: the placed photos, under the names that the user calls them by. Their lens and size
            are those of the user's files.

    Raises:
        InputError: a photo is unknown or has no place, a mark lies outside of it, the photos are
            too near to each other, or marks do not show the same point.
    """
    found = []
    for k in range(2):
        rays = []
        for name, marks in points.marks.items():
            photo = _photo(name, photos)
            if not ((marks >= 0) & (marks <= (photo.width, photo.height))).all():
                size = f"{photo.width} x {photo.height}"
                raise InputError(f"distance: {name} is {size} pixels: a mark lies outside of it")
            turn, shift = photo.cam_from_world[:3, :3], photo.cam_from_world[:3, 3]
            flat = np.append(unbent(marks[k : k + 1], photo.lens)[0], 1)
            rays.append((-turn.T @ shift, flat @ turn / np.linalg.norm(flat)))
        found.append(_nearest(rays, k))
        _check_shown(found[k], k, points, photos)
    apart = float(np.linalg.norm(found[0] - found[1]))
    if apart < 1e-9:
        raise InputError("distance: both points are at one place. Mark two different points")
    return points.metres / apart


def with_distance(model: SparseModel, views: Views, text: str) -> SparseModel:
    """The model with the size that a marked distance gives; as it is where nothing was marked.

    Raises:
        InputError: the text cannot be read, or the marks contradict the photos' places.
    """
    if not text.strip():
        return model
    sizes = {view.source: view.source_size or (view.width, view.height) for view in views.items}
    scale = metres_per_unit(parsed(text), marked_photos(model, views, sizes))
    return replace(model, metres_per_unit=scale)


def _photo(name: str, photos: Mapping[str, Marked]) -> Marked:
    if name in photos:
        return photos[name]
    raise InputError(
        f"distance: {name} is no photo that has a place. Mark others: `status` names those without"
    )


def _nearest(rays: list[tuple[F64, F64]], k: int) -> F64:
    """The point nearest to all rays."""
    centers, ahead = np.stack([r[0] for r in rays]), np.stack([r[1] for r in rays])
    if float(np.arccos(np.clip(ahead @ ahead.T, -1, 1)).max()) < LEAST_ANGLE:
        raise InputError(
            f"distance: the marked photos see point {k + 1} from nearly one direction: mark "
            "photos that were taken further apart"
        )
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None]
    return np.asarray(np.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0]))


def _check_shown(point: F64, k: int, points: TwoPoints, photos: Mapping[str, Marked]) -> None:
    """Refuse marks that are not of one point.

    Raises:
        InputError: the point that is nearest to all rays lies elsewhere in a photo, or behind it.
    """
    for name, marks in points.marks.items():
        photo = photos[name]
        pose = photo.cam_from_world
        if (pose[:3, :3] @ point + pose[:3, 3])[2] > 0:
            off = float(np.linalg.norm(shown(point[None], pose, photo.lens)[0] - marks[k]))
            if off <= MISS * max(photo.width, photo.height):
                continue
            words = f"{off:.0f} pixels off"
        else:
            words = "behind the camera"
        raise InputError(
            f"distance: the marks of point {k + 1} do not show one point: in {name} it is {words}. "
            "Mark the same two points in the same order"
        )
