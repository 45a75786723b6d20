"""One step: draw a photo's view, compare, go back, and update everything."""

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.ops import (
    Pinhole,
    Plan,
    composited,
    image_loss_and_error,
    mask_entropy,
    normal_agreement,
    normal_smoothness,
)
from refdgs_pipe.ops.scene import Extra
from refdgs_pipe.training import losses
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.shading import SHADED_ALPHA, Picture, draw

NEAR = 0.02  # of the distance of the nearest camera to the ball's centre


def near_of(model: SparseModel) -> float:
    """Depth before which nothing is drawn, world units."""
    return NEAR * min(float(np.linalg.norm(c.center - model.ball.center)) for c in model.cameras)


@dataclass(frozen=True)
class Taken:
    """What a step leaves to look at, without gradients.

    Args:
        loss, error: (), what was minimised and the mean squared error of the picture.
        image, target: (H, W, 3).
    """

    loss: Tensor
    error: Tensor
    image: Tensor
    target: Tensor


def take_step(
    field: TrainableField,
    photo: TrainingPhoto,
    backdrop: Tensor,
    fraction: float,
    *,
    plan: Plan | None = None,
    rates: Tensor | None = None,
) -> Taken:
    """One gradient and one update, of nothing where the plan's lists did not fit.

    Args:
        backdrop: (3,) sRGB, where the field is.
        fraction: of the schedule; it decides which parts of the field take part.
        rates: of `TrainableField.step`.
    """
    if plan is not None:
        plan.begin()
    p = field.params
    extra: Extra = "distortion" if p.distortion_weight > 0 else "depth"
    pinhole = field.pinhole(photo, fraction)
    still = replace(pinhole, cam_from_world=pinhole.cam_from_world.detach())
    scene = field.scene(still, fraction)
    picture = draw(scene, pinhole, backdrop, extra=extra, turn_share=p.turn_share, plan=plan)
    target = composited(photo.rgb, photo.mask, backdrop)
    if field.exposures is not None and photo.which is not None:
        picture = replace(picture, image=picture.image * field.exposures.factor(photo.which))
    loss, error = _loss(p, picture, photo, still, target)
    if field.weighs_specular(fraction):
        mirrored = losses.mirrored(picture.radiance, picture.pixels, picture.maps.alpha.numel())
        loss = loss + p.specular_weight * mirrored
    if field.exposures is not None and photo.which is not None:
        loss = loss + p.exposure_weight * field.exposures.strangeness(photo.which)
    if field.poses is not None and pinhole is not photo.pinhole:
        strangeness = field.poses.strangeness(photo.camera.name)
        loss = loss + p.pose_weight * strangeness.to(loss)
    loss.backward()  # type: ignore[no-untyped-call]
    misfit = None if plan is None else plan.misfit
    field.observe(picture, photo.pinhole.width, misfit)
    field.step(misfit, rates)
    return Taken(loss.detach(), error, picture.image.detach(), target)


def _loss(
    p: TrainParams, picture: Picture, photo: TrainingPhoto, pinhole: Pinhole, target: Tensor
) -> tuple[Tensor, Tensor]:
    """What is minimised, and the mean squared error of the picture."""
    maps = picture.maps
    valid = None if photo.valid is None else photo.valid.float()
    loss, error = image_loss_and_error(picture.image, target, weight=valid, ssim_share=p.ssim_share)
    # weights go in, so that backward has nothing to scale
    if photo.mask is not None and p.mask_weight > 0:
        loss = loss + mask_entropy(maps.alpha, photo.mask, weight=p.mask_weight)
    if photo.beyond is not None and p.mask_weight > 0:
        loss = loss + p.mask_weight * losses.out_of_place(picture.object_alpha, photo.beyond)
    if p.normal_weight > 0 and maps.normal is not None and maps.depth is not None:
        loss = loss + normal_agreement(
            maps.normal,
            maps.depth,
            maps.alpha,
            pinhole,
            edge=p.normal_edge,
            weight=p.normal_weight,
        )
    if p.smooth_weight > 0 and maps.normal is not None and maps.depth is not None:
        loss = loss + normal_smoothness(
            maps.normal,
            maps.features,
            maps.depth,
            maps.alpha,
            picture.object_alpha,
            shaded=SHADED_ALPHA,
            weight=p.smooth_weight,
        )
    if maps.distortion is not None:
        relative = maps.distortion.mean() / NEAR**2  # it is measured in near / depth
        loss = loss + p.distortion_weight * relative
    return loss, error
