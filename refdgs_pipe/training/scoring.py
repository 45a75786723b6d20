"""A finished field against the photos it has not seen."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.scores import Scores, ViewScore
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.metrics import psnr
from refdgs_pipe.ops import ssim_map
from refdgs_pipe.training.render import render_image, render_surface_map

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


def coverage(
    field: SurfelField, cameras: list[Camera], masks: list[F32] | None, ball: Ball
) -> float:
    """How much of the object a field shows, 0 to 1: the mean over views of intersection over union.

    Args:
        masks: (H, W) for each camera, at its size; None: nothing is known, and the share of the
            ball's disc that the object fills is returned.
    """
    shares = []
    for index, camera in enumerate(cameras):
        alpha = render_surface_map(field, camera).alpha
        if masks is not None:
            both, either = np.minimum(alpha, masks[index]), np.maximum(alpha, masks[index])
            shares.append(float(both.sum() / max(float(either.sum()), 1.0)))
            continue
        uv, depth = camera.project(ball.center[None])
        radius = float(camera.K[0, 0]) * ball.radius / max(float(depth[0]), 1e-9)
        ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
        disc = (xs - uv[0, 0]) ** 2 + (ys - uv[0, 1]) ** 2 < radius**2
        shares.append(float((alpha * disc).sum() / max(int(disc.sum()), 1)))
    return float(np.mean(shares))


def _tensor(image: F32) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, np.float32))
