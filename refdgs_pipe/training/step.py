"""One step: draw a photo's view, compare, go back, and update everything."""

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.ops import (
    Pinhole,
    Plan,
    composited,
    descend,
    image_loss_and_error,
    image_mean,
    mask_entropy,
    mirrored,
    normal_agreement,
    normal_smoothness,
    total,
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
    terms, error = _terms(p, picture, photo, still, target)
    if field.weighs_specular(fraction):
        count, weight = picture.maps.alpha.numel(), p.specular_weight
        terms.append(mirrored(picture.radiance, picture.pixels, count, weight=weight, whole=False))
    loss = total(terms)
    if field.exposures is not None and photo.which is not None:
        loss = loss + p.exposure_weight * field.exposures.strangeness(photo.which)
    if field.poses is not None and pinhole is not photo.pinhole:
        strangeness = field.poses.strangeness(photo.camera.name)
        loss = loss + p.pose_weight * strangeness.to(loss)
    descend(loss)
    misfit = None if plan is None else plan.misfit
    field.observe(picture, photo.lever, misfit)
    field.step(misfit, rates)
    return Taken(loss.detach(), error, picture.image.detach(), target)


def _terms(
    p: TrainParams, picture: Picture, photo: TrainingPhoto, pinhole: Pinhole, target: Tensor
) -> tuple[list[Tensor], Tensor]:
    """The terms whose total is minimised, and the mean squared error of the picture.

    Users of the maps take shares of them: 0 shading, 1 the composition, 2 normals, 3 the mask.
    """
    maps, flat = picture.maps, picture.maps.share(2)
    valid = None if photo.valid is None else photo.valid.float()
    loss, error = image_loss_and_error(picture.image, target, weight=valid, ssim_share=p.ssim_share)
    terms = [loss]
    # weights go in, so that backward has nothing to scale
    if photo.mask is not None and p.mask_weight > 0:
        alpha = maps.share(3).alpha
        terms.append(mask_entropy(alpha, photo.mask, weight=p.mask_weight, whole=False))
    if photo.beyond is not None and p.mask_weight > 0:
        terms.append(p.mask_weight * losses.out_of_place(picture.object_alpha, photo.beyond))
    if p.normal_weight > 0 and flat.normal is not None and flat.depth is not None:
        terms.append(
            normal_agreement(
                flat.normal,
                flat.depth,
                flat.alpha,
                pinhole,
                edge=p.normal_edge,
                weight=p.normal_weight,
                whole=False,
            )
        )
    normal = maps.share(3).normal
    if p.smooth_weight > 0 and normal is not None and maps.depth is not None:
        terms.append(
            normal_smoothness(
                normal,
                maps.features,
                maps.depth,
                maps.alpha,
                picture.object_alpha,
                shaded=SHADED_ALPHA,
                weight=p.smooth_weight,
                whole=False,
            )
        )
    if maps.distortion is not None:  # it is measured in near / depth
        weight = p.distortion_weight
        terms.append(image_mean(maps.distortion, weight=weight, divisor=NEAR**2, whole=False))
    return terms, error
