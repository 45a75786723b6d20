"""A finished field against the photos it has not seen."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.scores import Scores, ViewScore
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.metrics import psnr
from refdgs_pipe.ops import ssim_map
from refdgs_pipe.training.render import render_image

Track = Callable[[list[Camera]], Iterable[Camera]]
F32 = NDArray[np.float32]


def score_field(
    views: Views, model: SparseModel, field: SurfelField, *, scale: float, device: str, track: Track
) -> Scores:
    """Held-out views (all, if none was held out), masked photos over white.

    Args:
        scale: size of the comparison relative to the views' images.
        track: wraps the cameras, to report progress.
    """
    held_out = [camera for camera in model.cameras if camera.split == "test"]
    scored = []
    for camera in track(held_out or list(model.cameras)):
        photo = load_photo(views, model, camera, scale=scale)
        target = photo.rgb
        if photo.mask is not None:
            m = photo.mask[..., None]
            target = target * m + (1 - m)
        image = render_image(field, photo.camera, device=device)
        keep = photo.valid[..., None]
        image, target = np.where(keep, image, 0), np.where(keep, target, 0)
        similarity = ssim_map(_tensor(image), _tensor(target)).numpy()
        valid = np.broadcast_to(keep, image.shape)
        scored.append(
            ViewScore(
                camera.name, psnr(image[valid], target[valid]), float(similarity[valid].mean())
            )
        )
    return Scores("test" if held_out else "train", tuple(scored))


def _tensor(image: F32) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, np.float32))
