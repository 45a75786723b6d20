"""Every setting of a training run. Times are fractions of the run: a recipe can scale it."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from refdgs_pipe.params import Former, Params, PowerOfTwo


class TrainParams(Params):
    """Ref-DGS training. Defaults are the `glossy` recipe."""

    former: ClassVar[Mapping[str, Former]] = {
        "cuda_graph": Former(("auto", "on", "off"), "the option --cuda-graph")
    }

    iterations: int = Field(5000, ge=1, le=200_000, description="optimiser steps")
    max_side: int = Field(
        800, ge=32, le=8192, description="longest image side trained on, in pixels"
    )
    coarse: float = Field(
        0.5, gt=0, le=1, description="image scale at the start of the run; 1 = full size throughout"
    )
    coarse_until: float = Field(
        0.3, ge=0, le=1, description="fraction of the run trained at the coarse scale"
    )
    seed: int = Field(0, ge=0, description="of all random choices")

    reflection: bool = Field(True, description="false: diffuse colour only, the matte control")
    local: Literal["none", "shared", "dual"] = Field(
        "dual",
        description="near-field reflection features: none, on geometry surfels, or on their own",
    )
    mixing: Literal["adaptive", "sum"] = Field(
        "adaptive", description="the shader sees far and near features side by side, or their sum"
    )
    physical: bool = Field(True, description="the shader also sees roughness and cos(normal, view)")
    local_from: float = Field(
        0.0, ge=0, le=1, description="fraction of the run after which near-field features join"
    )
    reflect_from: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run after which reflections join, where there are masks",
    )
    environment_height: PowerOfTwo = Field(
        256,
        ge=16,
        le=1024,
        description="rows of the Sph-Mip map, a power of two; columns are twice",
    )
    bfloat16: bool = Field(
        True,
        description="the shader's network multiplies bfloat16 numbers where the CPU can: faster, "
        "equal in quality, but other CPUs give slightly other results",
    )
    diffuse_bias: float = Field(
        2.0, ge=0, le=10, description="initial diffuse is exp(-bias)/5: 0 bright, 2 dark"
    )

    surfels: int = Field(20_000, ge=100, le=2_000_000, description="geometry surfels at the start")
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
    local_surfels: int = Field(
        6_000, ge=100, le=2_000_000, description="local reflection surfels at the start"
    )
    max_local_surfels: int = Field(
        20_000, ge=100, le=5_000_000, description="local reflection surfels at most"
    )
    background_surfels: int = Field(
        60_000, ge=100, le=5_000_000, description="surfels outside the object ball at most"
    )
    start_opacity: float = Field(
        0.03, gt=0, lt=1, description="of surfels that start throughout the visual hull"
    )
    densify_from: float = Field(0.05, ge=0, le=1, description="fraction of the run")
    densify_until: float = Field(0.6, ge=0, le=1, description="fraction of the run")
    densify_every: int = Field(100, ge=1, le=10_000, description="steps between densifications")
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

    reset_every: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the run after which opacities are reset to 0.01, again and again "
        "until densify_until; 0: never",
    )

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

    anneal_from: float = Field(
        0.6, ge=0, le=1, description="fraction of the run from which steps shrink"
    )
    anneal_to: float = Field(0.05, gt=0, le=1, description="share of the steps left at the end")

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
    outline_cells: float = Field(
        1.5,
        ge=0,
        le=5,
        description="hull discs this near, in cells, start on the masks' outlines; 0: none",
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
    turn_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="share of a pixel's light that must be specular for what it mirrors to turn "
        "normals in full; below it they turn less, in proportion; 0: always in full",
    )
    renew_at: float = Field(
        0.65,
        ge=0,
        le=1,
        description="fraction of the run at which surfels start anew on the field's own mesh; "
        "1: never",
    )
    renew_surfels: float = Field(
        1.7, gt=0, le=10, description="surfels that then start for each that was there, a factor"
    )
    ground: Literal["background", "object"] = Field(
        "background",
        description="what the surface that the object stands on belongs to, where there are no "
        "masks and sparse points show one",
    )
    look_steps: int = Field(
        1000,
        ge=0,
        le=100_000,
        description="steps at the coarse scale in which the object is looked for, where there are "
        "no masks; 0: none, and surfels start throughout the ball",
    )
    unmasked: Literal["auto", "look", "stereo"] = Field(
        "auto",
        description="where surfels start without masks: look: where a first look finds the object; "
        "stereo: on what neighbouring photos agree on; auto: stereo for photos from one side",
    )
    start: Literal["hull", "volume", "carved", "ball"] = Field(
        "carved",
        description="where surfels start when there are masks: on their visual hull, throughout "
        "it, on it and in the hollows that photos agree on, or throughout the object ball",
    )
    volume_steps: int = Field(
        1200,
        ge=0,
        le=100_000,
        description="steps of fitting a coarse volume that shows more hollows, where surfels start "
        "carved; 0: none",
    )

    @property
    def most_surfels(self) -> int:
        """Geometry surfels at most, those that start anew among them."""
        renewed = self.renew_surfels if self.renew_at < 1 else 1.0
        return round(max(self.surfels, self.max_surfels) * max(1.0, renewed))
