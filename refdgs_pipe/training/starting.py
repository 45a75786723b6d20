"""The surfels that training starts with, as raw tensors: the object's and the background's."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import HOLLOW, SOLID, Start
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.training import initial
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.settings import StartParams
from refdgs_pipe.training.surfels import array, raw_diffuse_of

SURFACE_OPACITY = 0.5  # of discs on a surface that is known
BALL_OPACITY = 0.1
LOCAL_OPACITY = 0.1
BACKGROUND_OPACITY = 0.1
SKY_OPACITY = 0.9
BALL_MARGIN = 1.1  # object surfels may stray this far, in ball radii
SH_0 = 0.28209479177387814  # the constant real spherical harmonic


@dataclass(frozen=True)
class Given:
    """What the start is made from.

    Args:
        photos: on the CPU; those with masks start in their hull.
        hull: the solid that surfels start on, if it is known.
        hollow: (n, n, n) of its cells, the inside of a vessel.
        agreed: what photos without masks agree on, if that is what they start from.
        behind: the background's surfels, if they are known.
        covers: of `Start`.
        random: of `Start`; null: as the seed sets it.
        progress: told the steps done and their number; may raise.
    """

    params: StartParams
    model: SparseModel
    photos: list[TrainingPhoto]
    hull: initial.Hull | None = None
    hollow: np.ndarray | None = None
    agreed: initial.Cloud | None = None
    behind: dict[str, Tensor] | None = None
    covers: dict[str, np.ndarray] | None = None
    random: Tensor | None = None
    progress: Callable[[int, int], None] | None = None


def start_of(given: Given, *, masked: bool) -> Start:
    """Surfels for photos whose background was removed (`masked`), or was not."""
    p, model = given.params, given.model
    around = Surroundings(model, ground=p.ground == "background" and not masked)
    rng = np.random.default_rng(p.seed)
    geometry, faint = _geometry(given, around, rng)
    spread = initial.ball_cloud(model.ball, p.local_surfels, rng)
    local = initial.raw_discs(spread, LOCAL_OPACITY)
    background = None
    if not masked:
        background = given.behind or _background(given, around, rng)
    random = given.random
    if random is None:
        random = torch.Generator().manual_seed(p.seed).get_state()
    return Start(
        geometry=_arrays(geometry),
        local=_arrays(local),
        background=None if background is None else _arrays(background),
        faint=faint,
        covers=given.covers or {},
        ball=model.ball,
        random=random.numpy(),
        seed=p.seed,
        max_side=p.max_side,
        ground=p.ground,
        surfels=p.surfels,
        background_surfels=p.background_surfels,
        bfloat16=p.bfloat16,
        vessel=_vessel(given),
    )


def _vessel(given: Given) -> np.ndarray | None:
    """The cells of `Start.vessel`."""
    if given.hull is None or given.hollow is None:
        return None
    solid = np.where(given.hull.cells, SOLID, 0)
    return np.where(given.hollow, HOLLOW, solid).astype(np.uint8)


def _arrays(raw: dict[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: array(values) for name, values in raw.items()}


def _geometry(
    given: Given, around: Surroundings, rng: np.random.Generator
) -> tuple[dict[str, Tensor], bool]:
    """The object's surfels, and whether they are faint: spread where there may be nothing."""
    cloud, opacity = _geometry_cloud(given, around, rng)
    raw = initial.raw_discs(cloud, opacity)
    if given.agreed is not None:
        linear = linear_from_srgb(cloud.colors.astype(np.float32))
        raw["raw_diffuse"] = raw_diffuse_of(torch.from_numpy(linear))
    return raw, opacity < SURFACE_OPACITY


def _background(given: Given, around: Surroundings, rng: np.random.Generator) -> dict[str, Tensor]:
    """A sky, and what is known to lie outside of the object."""
    model = given.model
    cameras = [photo.camera for photo in given.photos]
    mean = torch.stack([photo.rgb.float().mean((1, 2)) for photo in given.photos]).mean(0) / 255
    cloud = initial.sky_cloud(model.ball, cameras, mean.double().numpy())
    opacity = BACKGROUND_OPACITY
    if given.agreed is not None:
        own = around.objects(torch.from_numpy(given.agreed.points)).numpy()
        cloud = initial.joined(cloud, initial.chosen(given.agreed, ~own))
        opacity = SURFACE_OPACITY
    else:
        outside = ~around.objects(torch.from_numpy(model.points)).numpy()
        if outside.any():
            points, colors = model.points[outside], model.point_colors[outside]
            cloud = initial.joined(cloud, initial.sparse_cloud(points, colors, cameras, rng))
    raw = initial.raw_discs(cloud, opacity)
    raw["raw_opacities"][: initial.SKY_SURFELS] = math.log(SKY_OPACITY / (1 - SKY_OPACITY))
    sh = torch.zeros(len(cloud.points), 12)
    sh[:, :3] = (torch.tensor(cloud.colors, dtype=torch.float32) - 0.5) / SH_0
    raw["sh"] = sh
    return raw


def _geometry_cloud(
    given: Given, around: Surroundings, rng: np.random.Generator
) -> tuple[initial.Cloud, float]:
    """Where the object's surfels start, and how opaque they are."""
    p, model, photos = given.params, given.model, given.photos
    if given.agreed is not None:
        own = around.objects(torch.from_numpy(given.agreed.points)).numpy()
        return initial.chosen(given.agreed, own), SURFACE_OPACITY
    if p.masked != "ball" and all(photo.mask is not None for photo in photos):
        hull = given.hull or initial.object_hull(p, model, photos, given.progress)
        if hull is not None:
            cloud = initial.hull_cloud(p, hull, photos, rng)
            return cloud, p.opacity if p.masked == "volume" else SURFACE_OPACITY
    cloud = initial.ball_cloud(model.ball, p.surfels, rng)
    cloud = initial.chosen(cloud, around.above(torch.from_numpy(cloud.points)).numpy())
    inside = around.objects(torch.from_numpy(model.points), BALL_MARGIN).numpy()
    if inside.any():
        points, colors = model.points[inside], model.point_colors[inside]
        sparse = initial.sparse_cloud(points, colors, [photo.camera for photo in photos], rng)
        cloud = initial.joined(cloud, sparse)
    return cloud, BALL_OPACITY
