"""The object's masks by the explanation of its foot on which the photos agree best."""

from collections.abc import Callable

import numpy as np

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.masking.foot import foot
from refdgs_pipe.masking.rounds import ROUNDS, Found, solved

BETTER = 0.015  # agreement: a foot where nothing proves the plane has to gain that much


def object_masks(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    progress: Callable[[int, int], None],
    *,
    threads: int = 1,
    light: Lighting | None = None,
) -> Found | None:
    """Masks of what stands on a plane, or None where nothing is found.

    Where nothing proves that photos see the plane, the object may stand, or hang over ground that
    is plain or in shade. Then both are tried. It stands there if masks then agree clearly better
    with one solid: a foot that is taken for ground is cut off differently in each photo.

    Args:
        plane: unit normal and offset, world.
        progress: told the rounds done and their number; may raise.
        threads: photos that are worked on at a time; the result does not depend on it.
        light: a flash, whose shadow moves with it, or a turntable; None for a still light.
    """
    flash = light is not None and light.lamp is not None
    progress(0, ROUNDS)
    stands = foot(views, model, plane, threads, flash=flash)
    total, done = (ROUNDS if stands.unproven is None else 2 * ROUNDS), 0

    def told() -> None:
        nonlocal done
        progress(done, total)
        done += 1

    free = solved(views, model, plane, stands, told, threads=threads, light=light)
    if stands.unproven is None:
        return free
    done = ROUNDS
    there = stands.on_unproven()
    standing = solved(views, model, plane, there, told, threads=threads, light=light)
    if free is None or standing is None:
        return standing or free
    gain = agreement(standing)[0] - agreement(free)[0]
    return standing if gain > BETTER else free


def agreement(found: Found) -> tuple[float, float]:
    """How well the masks agree with the solid that all of them show: mean and worst tenth.

    Intersection over union of each mask with the solid's silhouette.
    """
    shares = []
    for mask, outline in zip(found.masks, found.outlines, strict=True):
        inside = mask > 0.5
        union = int((inside | outline).sum())
        shares.append(float((inside & outline).sum()) / union if union else 0.0)
    return float(np.mean(shares)), float(np.quantile(shares, 0.1))
