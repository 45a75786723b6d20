"""The light of the ground below the object, from the photos that show it beside the object."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.ground.radiance import LONGEST, MOST, Exposed, ground_radiance
from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.texture.sampling import exposure

_ALPHA = 0.9  # from which the field tells a photo's exposure


def light_below(
    drawn: Callable[[Camera], SurfaceMap],
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float] | None,
    lighting: Lighting,
    track: Callable[[list[Camera], str], Iterable[Camera]],
) -> GroundLight | None:
    """The light that photos show there; None without a plane, or where the light moves.

    Args:
        drawn: what the field looks like, which tells how each photo is exposed.
        plane: unit normal and offset, world.
        track: yields the cameras, and reports progress under a label.

    Raises:
        CorruptError: a photo or its mask is missing or damaged.
    """
    if plane is None or views.background == "removed" or lighting.kind != "world":
        return None
    cameras = model.training_cameras
    some = np.unique(np.linspace(0, len(cameras) - 1, MOST).round().astype(int))

    def shown() -> Iterator[Exposed]:
        for camera in track([cameras[i] for i in some], "looking at the ground"):
            scale = min(1.0, LONGEST / max(camera.width, camera.height))
            photo = load_photo(views, model, camera, scale=scale)
            view = drawn(photo.camera)
            there = (view.alpha >= _ALPHA)[..., None]
            seen = np.where(there, linear_from_srgb(photo.alone()), np.float32(np.nan))
            yield Exposed(photo, float(exposure(seen, linear_from_srgb(view.color))))

    return ground_radiance(shown(), model.ball, plane)
