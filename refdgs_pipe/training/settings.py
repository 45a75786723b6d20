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
    """Photos and random seed"""

    max_side: int = Field(
        800,
        ge=32,
        le=8192,
        description="longest side of training photos, in pixels; photos with masks are cut to "
        "the object, and reduced less if they show it small",
    )
    seed: int = Field(0, ge=0, description="seed of all random choices in training")


class ObjectParams(Params):
    """Where the object is"""

    ground: Literal["background", "object"] = Field(
        "background",
        description="without masks, what the ground below the object belongs to, if sparse points "
        "show it",
    )
    masked: Literal["hull", "volume", "carved", "ball"] = Field(
        "carved",
        description="where surfels start with masks. hull: on the visual hull; volume: throughout "
        "it; carved: on the hull without the hollows that photos show; ball: throughout the "
        "object ball",
    )
    unmasked: Literal["auto", "look", "stereo"] = Field(
        "auto",
        description="where surfels start without masks. look: where a first look finds the object; "
        "stereo: where neighbouring photos agree; auto: stereo for photos from one side, else look",
    )
    volume_steps: int = Field(
        1200,
        ge=0,
        le=100_000,
        description="steps for a coarse volume that finds more hollows, if masked is carved; "
        "0: no volume",
    )
    vessels: bool = Field(
        True,
        description="open a level top as the mouth of a vessel if photos agree better on what lies "
        "below",
    )
    outline_cells: float = Field(
        1.5,
        ge=0,
        le=5,
        description="discs this near to the masks' outlines start on them, in hull cells; 0: none",
    )


class LookParams(Params):
    """First look at photos without masks"""

    look_steps: int = Field(
        1000,
        ge=0,
        le=100_000,
        description="steps of the first look, which finds the object without masks; 0: none, and "
        "surfels start throughout the ball",
    )
    look_scale: float = Field(0.5, gt=0, le=1, description="image scale of the first look")
    look_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="most geometry surfels of the first look"
    )
    look_surfels_per_pixel: float = Field(
        1.5,
        gt=0,
        le=100,
        description="most geometry surfels of the first look, for each pixel of half the ball's "
        "disc",
    )
    look_environment: PowerOfTwo = Field(
        256,
        ge=16,
        le=1024,
        description="rows of the first look's environment map (Sph-Mip), a power of two",
    )


class CountParams(Params):
    """Surfels at the start"""

    surfels: int = Field(20_000, ge=100, le=2_000_000, description="geometry surfels at the start")
    local_surfels: int = Field(
        6_000, ge=100, le=2_000_000, description="local reflection surfels at the start"
    )
    background_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="most surfels outside the object ball"
    )


class StartExperimentParams(Params):
    """Start, for experiments"""

    opacity: float = Field(
        0.03, gt=0, lt=1, description="opacity of surfels that start throughout the visual hull"
    )
    bfloat16: bool = Field(
        True,
        description="multiply bfloat16 numbers in the shader's network, on a GPU and where the CPU "
        "can: faster, equal in quality; results differ slightly from those of other CPUs",
    )


class StartParams(PhotoParams, ObjectParams, LookParams, CountParams, StartExperimentParams):
    """Where surfels start: on what masks, a first look or neighbouring photos show."""


class ScheduleParams(Params):
    """Schedule"""

    iterations: int = Field(5000, ge=1, le=200_000, description="optimiser steps")
    coarse: float = Field(
        0.5, gt=0, le=1, description="image scale at the start of the run; 1: full size throughout"
    )
    coarse_until: float = Field(
        0.3, ge=0, le=1, description="fraction of the run trained at the coarse scale"
    )
    renew_at: float = Field(
        0.65,
        ge=0,
        le=1,
        description="fraction of the run at which surfels are restarted on the field's own mesh; "
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
    densify_from: float = Field(
        0.05, ge=0, le=1, description="fraction of the run from which surfels are split and cloned"
    )
    densify_until: float = Field(
        0.6, ge=0, le=1, description="fraction of the run until which surfels are split and cloned"
    )
    densify_every: int = Field(
        100, ge=1, le=10_000, description="optimiser steps between splitting and cloning"
    )
    anneal_from: float = Field(
        0.6, ge=0, le=1, description="fraction of the run from which learning rates shrink"
    )
    anneal_to: float = Field(
        0.05, gt=0, le=1, description="share of the learning rates that is left at the end"
    )


class SurfelParams(Params):
    """Surfels"""

    max_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="most geometry surfels before the restart"
    )
    surfels_per_pixel: float = Field(
        1.5,
        gt=0,
        le=100,
        description="most geometry surfels for each pixel that the object covers in the mean "
        "photo; half as many local ones",
    )
    max_local_surfels: int = Field(
        20_000, ge=100, le=5_000_000, description="most local reflection surfels"
    )
    densify_gradient: float = Field(
        2e-4,
        gt=0,
        le=1,
        description="surfels with a larger mean screen gradient are split or cloned (loss per half "
        "image width)",
    )
    split_size: float = Field(
        0.003,
        gt=0,
        le=1,
        description="surfels above this size are split, others cloned, in scene extents",
    )
    prune_opacity: float = Field(
        0.2,
        ge=0,
        lt=1,
        description="surfels below this opacity are removed; at most 0.05 where they start faint",
    )
    local_prune_opacity: float = Field(
        0.01, ge=0, lt=1, description="local surfels below this opacity are removed"
    )


class LightParams(Params):
    """Light"""

    reflection: bool = Field(
        True, description="true: model reflections; false: diffuse colour only"
    )
    local: Literal["none", "shared", "dual"] = Field(
        "dual",
        description="near-field features. none; shared: on the geometry surfels; dual: on surfels "
        "of their own",
    )
    local_trial_steps: int = Field(
        1200,
        ge=0,
        description="steps of each of two short trainings, with near-field surfels and without, "
        "that decide whether they stay; 0: they stay",
    )
    mixing: Literal["adaptive", "sum"] = Field(
        "adaptive",
        description="what the shader sees. adaptive: far and near features side by side; sum: "
        "their sum",
    )
    physical: bool = Field(True, description="the shader also sees roughness and cos(normal, view)")
    environment_height: PowerOfTwo = Field(
        256,
        ge=16,
        le=1024,
        description="rows of the environment map (Sph-Mip), a power of two; twice as many columns",
    )
    diffuse_bias: float = Field(
        2.0, ge=0, le=10, description="diffuse colour starts at exp(-bias)/5; 0: bright, 2: dark"
    )
    turn_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="specular share of a pixel's light from which its mirrored direction turns "
        "normals in full; below it in proportion; 0: always in full",
    )


class LossParams(Params):
    """Losses"""

    ssim_share: float = Field(0.2, ge=0, le=1, description="share of 1 - SSIM in the image loss")
    mask_weight: float = Field(
        0.1, ge=0, le=10, description="weight of the cross-entropy of opacity against masks"
    )
    normal_weight: float = Field(
        0.2, ge=0, le=10, description="weight of the agreement of normals with depth"
    )
    normal_edge: float = Field(
        5.0,
        gt=0,
        le=1e6,
        description="normals need not agree where depth bends by more pixel footprints than this",
    )
    distortion_weight: float = Field(
        4.0,
        ge=0,
        le=1e6,
        description="weight of the depth distortion: the squared spread of nearest camera / depth",
    )
    smooth_weight: float = Field(
        0.05,
        ge=0,
        le=10,
        description="weight of smooth normals, except across edges of diffuse colour and depth",
    )
    specular_weight: float = Field(
        0.1,
        ge=0,
        le=10,
        description="weight of specular radiance: diffuse colour takes what it explains as well",
    )
    specular_from: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run from which specular_weight counts",
    )


class RateParams(Params):
    """Rates"""

    rate_means: float = Field(
        5e-4,
        gt=0,
        le=1,
        description="initial learning rate of centres, in scene extents; falls to 1/100",
    )
    rate_opacities: float = Field(0.05, gt=0, le=1, description="learning rate of raw opacities")
    rate_scales: float = Field(0.005, gt=0, le=1, description="learning rate of log scales")
    rate_quats: float = Field(0.001, gt=0, le=1, description="learning rate of quaternions")
    rate_diffuse: float = Field(0.02, gt=0, le=1, description="learning rate of raw diffuse colour")
    rate_roughness: float = Field(0.002, gt=0, le=1, description="learning rate of raw roughness")
    rate_features: float = Field(0.006, gt=0, le=1, description="learning rate of local features")
    rate_environment: float = Field(
        0.006, gt=0, le=1, description="learning rate of the environment map"
    )
    rate_shader: float = Field(
        1.5e-3, gt=0, le=1, description="learning rate of the shader's weights"
    )


class TrainExperimentParams(Params):
    """Training, for experiments: off, or not worth changing"""

    reset_every: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run between resets of opacities to 0.01, until densify_until; "
        "0: never",
    )
    patience: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run without gain on held-out pixels after which training "
        "jumps to anneal_from; 0: off, no pixels are held out",
    )
    patience_tolerance: float = Field(
        0.05, ge=0, le=10, description="least gain on held-out pixels that counts, in dB"
    )
    exposure: Literal["fixed", "fitted"] = Field(
        "fixed",
        description="fitted: photos without masks have a brightness factor each; fixed: all photos "
        "were exposed alike",
    )
    exposure_weight: float = Field(
        0.05,
        ge=0,
        le=10,
        description="weight of the squared logarithm of a photo's brightness factor",
    )
    rate_exposure: float = Field(
        0.002, gt=0, le=1, description="learning rate of the logarithms of these factors"
    )
    poses: Literal["fixed", "refined"] = Field(
        "fixed",
        description="refined: poses that structure from motion found are corrected in training; "
        "fixed: they stay",
    )
    pose_weight: float = Field(
        1.0,
        ge=0,
        le=1e4,
        description="weight of a pose's squared correction, in radians and camera distances",
    )
    rate_poses: float = Field(5e-4, gt=0, le=0.1, description="rate of poses; it falls to 1/100")


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
        description="surfels on the mesh after the restart for each one before it, a factor",
    )
    turning: float = Field(
        0.1, ge=0, le=1, description="share of train.rate_quats that is left after the restart"
    )
