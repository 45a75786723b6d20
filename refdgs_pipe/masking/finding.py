"""The object's masks, by the explanation of its foot whose masks agree best with one solid."""

from collections.abc import Callable
from itertools import count

import numpy as np

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.masking.foot import Foot, foot
from refdgs_pipe.masking.rounds import ROUNDS, Found, solved

BETTER = 0.005  # agreement: a foot where nothing proves the plane has to gain that much


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

    Where something hides the plane and no texture proves it, the object may stand there, or hang
    over ground that is plain or in shade. Then masks are made for both. Those for an object that
    stands are taken if they agree better with one solid, by more than `BETTER`: a foot that is
    taken for ground is cut off differently in each photo.

    Args:
        plane: unit normal and offset, world.
        progress: told the rounds done and their number; may raise.
        threads: photos that are worked on at a time; the result does not depend on it.
        light: a flash, whose shadow moves with it, or a turntable; None for a still light.
    """
    progress(0, ROUNDS)
    hanging = foot(views, model, plane, threads, light=light)
    standing = hanging.on_unproven()
    total = ROUNDS if standing is hanging else 2 * ROUNDS

    def explained(stands: Foot, before: int) -> Found | None:
        rounds = count(before)
        given = (views, model, plane, stands, lambda: progress(next(rounds), total))
        return solved(*given, threads=threads, light=light)

    one = explained(hanging, 0)
    if standing is hanging:
        return one
    other = explained(standing, ROUNDS)
    if one is None or other is None:
        return one or other
    return other if agreement(other)[0] - agreement(one)[0] > BETTER else one


def warnings_of(found: Found) -> list[str]:
    """What people have to know about the masks, in sentences."""
    if not found.beside:
        return []
    things = "1 small thing stands" if found.beside == 1 else f"{found.beside} small things stand"
    left_out = "is not part of the asset" if found.beside == 1 else "are not part of the asset"
    return [
        f"{things} beside the object and {left_out}. If this is wrong, move the parts closer "
        "together and take the photos again, or give masks"
    ]


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
