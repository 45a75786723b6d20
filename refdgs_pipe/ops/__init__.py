"""Differentiable operations on surfels and maps, each defined by a torch reference in float64."""

from refdgs_pipe.ops.adam import adam_step, rates_of
from refdgs_pipe.ops.clip import clip, srgb_curve
from refdgs_pipe.ops.definition.rasterize import rotation_matrices
from refdgs_pipe.ops.elementwise import (
    activated,
    damped,
    descend,
    diffuse_of,
    image_mean,
    mirrored,
    observe,
    total,
)
from refdgs_pipe.ops.image_loss import image_loss, image_loss_and_error, ssim, ssim_map
from refdgs_pipe.ops.mlp import mlp
from refdgs_pipe.ops.photo import composited, mask_entropy
from refdgs_pipe.ops.plan import Plan, Readback
from refdgs_pipe.ops.rasterize import rasterize
from refdgs_pipe.ops.scene import Extra, Maps, Pinhole, ScreenStatistics, Surfels
from refdgs_pipe.ops.shade import (
    composite,
    covered_pixels,
    normal_agreement,
    normal_smoothness,
    shading_inputs,
)
from refdgs_pipe.ops.sph_mip import mip_levels, sph_mip

__all__ = [
    "Extra",
    "Maps",
    "Pinhole",
    "Plan",
    "Readback",
    "ScreenStatistics",
    "Surfels",
    "activated",
    "adam_step",
    "clip",
    "composite",
    "composited",
    "covered_pixels",
    "damped",
    "descend",
    "diffuse_of",
    "image_loss",
    "image_loss_and_error",
    "image_mean",
    "mask_entropy",
    "mip_levels",
    "mirrored",
    "mlp",
    "normal_agreement",
    "normal_smoothness",
    "observe",
    "rasterize",
    "rates_of",
    "rotation_matrices",
    "shading_inputs",
    "sph_mip",
    "srgb_curve",
    "ssim",
    "ssim_map",
    "total",
]
