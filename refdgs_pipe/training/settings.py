"""The settings of training: where surfels start, how they are trained, how they start anew.

A setting belongs to the first stage that uses it; later stages find its value in that stage's
artifact. Each class is a group that `recipe show` lists under its docstring. Times are fractions of
the run: a recipe can scale it.
"""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from refdgs_pipe.params import Former, Params, PowerOfTwo


class PhotoParams(Params):
    """Photos and chance"""

    max_side: int = Field(
        800, ge=32, le=8192, description="longest image side trained on, in pixels"
    )
    seed: int = Field(0, ge=0, description="of all random choices of training")


class ObjectParams(Params):
    """Where the object is"""

    ground: Literal["background", "object"] = Field(
        "background",
        description="what the surface that the object stands on belongs to, where there are no "
        "masks and sparse points show one",
    )
    masked: Literal["hull", "volume", "carved", "ball"] = Field(
        "carved",
        description="where surfels start when there are masks: on their visual hull, throughout "
        "it, on it and in the hollows that photos agree on, or throughout the object ball",
    )
    unmasked: Literal["auto", "look", "stereo"] = Field(
        "auto",
        description="where surfels start without masks: look: where a first look finds the object; "
        "stereo: on what neighbouring photos agree on; auto: stereo for photos from one side",
    )
    volume_steps: int = Field(
        1200,
        ge=0,
        le=100_000,
        description="steps of fitting a coarse volume that shows more hollows, where surfels start "
        "carved; 0: none",
    )
    vessels: bool = Field(
        True,
        description="whether a level top is tried as the mouth of a vessel: two short trainings "
        "are judged by photos that they did not see",
    )
    outline_cells: float = Field(
        1.5,
        ge=0,
        le=5,
        description="hull discs this near, in cells, start on the masks' outlines; 0: none",
    )


class LookParams(Params):
    """First look at photos without masks"""

    look_steps: int = Field(
        1000,
        ge=0,
        le=100_000,
        description="steps in which the object is looked for, where there are no masks; 0: none, "
        "and surfels start throughout the ball",
    )
    look_scale: float = Field(0.5, gt=0, le=1, description="image scale of the first look")
    look_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="geometry surfels of the first look at most"
    )
    look_surfels_per_pixel: float = Field(
        1.5,
        gt=0,
        le=100,
        description="geometry surfels of the first look at most, for each pixel of half the "
        "ball's disc",
    )
    look_environment: PowerOfTwo = Field(
        256, ge=16, le=1024, description="rows of the Sph-Mip map of the first look, a power of two"
    )


class CountParams(Params):
    """Surfels at the start"""

    surfels: int = Field(20_000, ge=100, le=2_000_000, description="geometry surfels at the start")
    local_surfels: int = Field(
        6_000, ge=100, le=2_000_000, description="local reflection surfels at the start"
    )
    background_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="surfels outside the object ball at most"
    )


class StartExperimentParams(Params):
    """Start, for experiments"""

    opacity: float = Field(
        0.03, gt=0, lt=1, description="of surfels that start throughout the visual hull"
    )
    bfloat16: bool = Field(
        True,
        description="the shader's network multiplies bfloat16 numbers where the CPU can: faster, "
        "equal in quality, but other CPUs give slightly other results",
    )


class StartParams(PhotoParams, ObjectParams, LookParams, CountParams, StartExperimentParams):
    """Where surfels start: on what masks, a first look or neighbouring photos show."""


class ScheduleParams(Params):
    """Schedule"""

    iterations: int = Field(5000, ge=1, le=200_000, description="optimiser steps")
    coarse: float = Field(
        0.5, gt=0, le=1, description="image scale at the start of the run; 1 = full size throughout"
    )
    coarse_until: float = Field(
        0.3, ge=0, le=1, description="fraction of the run trained at the coarse scale"
    )
    renew_at: float = Field(
        0.65,
        ge=0,
        le=1,
        description="fraction of the run at which surfels start anew on the field's own mesh; "
        "1: never",
    )
    reflect_from: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run after which reflections join, where there are masks",
    )
    local_from: float = Field(
        0.0, ge=0, le=1, description="fraction of the run after which near-field features join"
    )
    densify_from: float = Field(0.05, ge=0, le=1, description="fraction of the run")
    densify_until: float = Field(0.6, ge=0, le=1, description="fraction of the run")
    densify_every: int = Field(100, ge=1, le=10_000, description="steps between densifications")
    anneal_from: float = Field(
        0.6, ge=0, le=1, description="fraction of the run from which steps shrink"
    )
    anneal_to: float = Field(0.05, gt=0, le=1, description="share of the steps left at the end")


class SurfelParams(Params):
    """Surfels"""

    max_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="geometry surfels at most, until they start anew"
    )
    surfels_per_pixel: float = Field(
        1.5,
        gt=0,
        le=100,
        description="geometry surfels at most, and twice the local ones, for each pixel that the "
        "object covers in the mean photo",
    )
    max_local_surfels: int = Field(
        20_000, ge=100, le=5_000_000, description="local reflection surfels at most"
    )
    densify_gradient: float = Field(
        2e-4,
        gt=0,
        le=1,
        description="mean screen gradient (loss per half image width) to densify at",
    )
    split_size: float = Field(
        0.003, gt=0, le=1, description="surfels larger than this are split, in scene extents"
    )
    prune_opacity: float = Field(
        0.2,
        ge=0,
        lt=1,
        description="surfels fainter than this go; 0.05 at most where they start faint",
    )
    local_prune_opacity: float = Field(
        0.01, ge=0, lt=1, description="local surfels fainter than this go"
    )


class LightParams(Params):
    """Light"""

    reflection: bool = Field(True, description="false: diffuse colour only, the matte control")
    local: Literal["none", "shared", "dual"] = Field(
        "dual",
        description="near-field reflection features: none, on geometry surfels, or on their own",
    )
    mixing: Literal["adaptive", "sum"] = Field(
        "adaptive", description="the shader sees far and near features side by side, or their sum"
    )
    physical: bool = Field(True, description="the shader also sees roughness and cos(normal, view)")
    environment_height: PowerOfTwo = Field(
        256,
        ge=16,
        le=1024,
        description="rows of the Sph-Mip map, a power of two; columns are twice",
    )
    diffuse_bias: float = Field(
        2.0, ge=0, le=10, description="initial diffuse is exp(-bias)/5: 0 bright, 2 dark"
    )
    turn_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="share of a pixel's light that must be specular for what it mirrors to turn "
        "normals in full; below it they turn less, in proportion; 0: always in full",
    )


class LossParams(Params):
    """Losses"""

    ssim_share: float = Field(0.2, ge=0, le=1, description="share of 1 - SSIM in the image loss")
    mask_weight: float = Field(
        0.1, ge=0, le=10, description="weight of the alpha's cross-entropy against masks"
    )
    normal_weight: float = Field(
        0.2, ge=0, le=10, description="weight of the agreement of normals with depth"
    )
    normal_edge: float = Field(
        5.0,
        gt=0,
        le=1e6,
        description="normals need not agree where the depth bends by more pixel footprints",
    )
    distortion_weight: float = Field(
        4.0,
        ge=0,
        le=1e6,
        description="weight of the depth distortion, of 1 / depth in units of the nearest camera's",
    )
    smooth_weight: float = Field(
        0.05,
        ge=0,
        le=10,
        description="weight of normal smoothness away from diffuse and depth edges",
    )
    specular_weight: float = Field(
        0.1,
        ge=0,
        le=10,
        description="weight of specular radiance: what diffuse colour explains as well is diffuse",
    )
    specular_from: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run after which specular radiance has a weight",
    )


class RateParams(Params):
    """Rates"""

    rate_means: float = Field(
        5e-4, gt=0, le=1, description="initial step of centres, in scene extents; ends at 1/100"
    )
    rate_opacities: float = Field(0.05, gt=0, le=1, description="step of raw opacities")
    rate_scales: float = Field(0.005, gt=0, le=1, description="step of log scales")
    rate_quats: float = Field(0.001, gt=0, le=1, description="step of quaternions")
    rate_diffuse: float = Field(0.02, gt=0, le=1, description="step of raw diffuse colour")
    rate_roughness: float = Field(0.002, gt=0, le=1, description="step of raw roughness")
    rate_features: float = Field(0.006, gt=0, le=1, description="step of local features")
    rate_environment: float = Field(0.006, gt=0, le=1, description="step of the Sph-Mip map")
    rate_shader: float = Field(1.5e-3, gt=0, le=1, description="step of the shader's weights")


class TrainExperimentParams(Params):
    """Training, for experiments: off, or not worth changing"""

    reset_every: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run after which opacities are reset to 0.01, again and again "
        "until densify_until; 0: never",
    )
    patience: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run without gain on held-out pixels after which the rest up "
        "to anneal_from is left out; 0 = hold nothing out and never",
    )
    patience_tolerance: float = Field(
        0.05, ge=0, le=10, description="dB on held-out pixels that count as a gain"
    )
    exposure: Literal["fixed", "fitted"] = Field(
        "fixed",
        description="fitted: where the background is photographed, each photo has a factor for how "
        "bright it is; fixed: all were exposed alike",
    )
    exposure_weight: float = Field(
        0.05, ge=0, le=10, description="weight of the squared logarithm of a photo's factor"
    )
    rate_exposure: float = Field(
        0.002, gt=0, le=1, description="step of the logarithms of the photos' factors"
    )
    poses: Literal["fixed", "refined"] = Field(
        "fixed",
        description="refined: poses that structure from motion found are corrected on the way; "
        "fixed: they are right",
    )
    pose_weight: float = Field(
        1.0,
        ge=0,
        le=1e4,
        description="weight of a pose's squared correction, in radians and camera distances",
    )
    rate_poses: float = Field(
        5e-4, gt=0, le=0.1, description="step of a pose's correction; ends at 1/100"
    )


class TrainParams(
    ScheduleParams, SurfelParams, LightParams, LossParams, RateParams, TrainExperimentParams
):
    """Ref-DGS training. Defaults are the `glossy` recipe."""

    former: ClassVar[Mapping[str, Former]] = {
        "cuda_graph": Former(("auto", "on", "off"), "the option --cuda-graph")
    }
    renamed: ClassVar[Mapping[str, str]] = {
        "max_side": "start.max_side",
        "seed": "start.seed",
        "ground": "start.ground",
        "start": "start.masked",
        "unmasked": "start.unmasked",
        "volume_steps": "start.volume_steps",
        "outline_cells": "start.outline_cells",
        "start_opacity": "start.opacity",
        "look_steps": "start.look_steps",
        "surfels": "start.surfels",
        "local_surfels": "start.local_surfels",
        "background_surfels": "start.background_surfels",
        "bfloat16": "start.bfloat16",
        "renew_surfels": "refine.surfels",
    }


class RefineParams(Params):
    """The last part of training, after surfels started anew on the field's own mesh."""

    surfels: float = Field(
        1.7,
        gt=0,
        le=10,
        description="surfels that start on the mesh for each that was there, a factor",
    )
    turning: float = Field(
        0.1, ge=0, le=1, description="share of train.rate_quats that is left from then on"
    )
