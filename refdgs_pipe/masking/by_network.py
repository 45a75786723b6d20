"""The object's masks from a network of the user's, and whether one solid can have them all."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.child_process import ChildCrashed, call_in_child
from refdgs_pipe.errors import InputError
from refdgs_pipe.ground.shots import F32, Bools, Shot, grown, resized
from refdgs_pipe.masking.network import PHOTO_S, SIDE, U8, Network
from refdgs_pipe.masking.solid import agreed, grid, pixels_of, silhouette

OnProgress = Callable[[str, int, int | None], None]

STEEP = 4.0  # of the rise from surroundings to object, round a probability of a half
LOOK_SIDE = 400  # px: photos at which masks are compared with a solid
LEAST_CELLS = 50
GROWTH = 0.25  # cells by which a mask is widened before it denies
WIDE = 1.5  # radii of the model's ball, which is a guess, that the solid is looked for in
COARSE, FINE = (64, 0.15), (96, 0.08)  # cells along an edge, share of the photos that may deny one
ODD = 0.7  # agreement below which a single photo is named
FULL = 0.9  # share of a picture: masks of more than that tell nothing from anything


@dataclass(frozen=True)
class Told:
    """What a network says of the photos of a model.

    Args:
        masks: (h, w) in [0, 1] for each camera; where it finds nothing, the solid's silhouette.
        shares: of each camera, how far its mask agrees with the silhouette of the solid
            (intersection over union); 0 where the masks have no solid in common.
        photos: names of the photos, as the user has them.
        shown: whether the network finds the object, for each camera.
    """

    masks: list[F32]
    shares: list[float]
    photos: list[str]
    shown: list[bool]

    @property
    def agreement(self) -> float:
        """Mean over the photos in which the network finds the object."""
        return float(
            np.mean([s for s, is_shown in zip(self.shares, self.shown, strict=True) if is_shown])
        )

    def warnings(self, limit: float) -> list[str]:
        """What is odd about the masks, and what to do about it.

        Args:
            limit: agreement that is expected.
        """
        said = []
        empty = [name for name, shown in zip(self.photos, self.shown, strict=True) if not shown]
        if empty:
            said.append(
                f"the network finds no object in {len(empty)} of {len(self.photos)} photos "
                f"({_some(empty)}). There the outline of the solid that the other masks show is "
                "taken. If it is wrong in the report, leave these photos out, or edit the masks "
                "and adopt them"
            )
        covered = float(np.median([np.mean(mask > 0.5) for mask in self.masks]))
        if covered > FULL:
            said.append(
                f"the network takes {covered:.0%} of the pictures for the object. Look at the "
                "section Masks of the report; try another masks.model_input or another network"
            )
        order = np.argsort(self.shares, kind="stable")
        worst = [self.photos[i] for i in order if self.shown[i]]
        odd = [self.photos[i] for i in order if self.shown[i] and self.shares[i] < ODD]
        if self.agreement < limit:
            said.append(
                f"the network's masks agree by {self.agreement:.1%} with one solid; {limit:.1%} is "
                f"expected. They are farthest off in {_some(worst)}. Look at the section Masks of "
                "the report; try another masks.model_input, edit the masks and adopt them, or run "
                'with --mask-model ""'
            )
        elif odd:
            said.append(
                f"the network's masks of {len(odd)} photos do not fit the others ({_some(odd)}). "
                "Look at them in the report; edit the masks and adopt them, or leave these photos "
                "out"
            )
        return said


def check_network(network: Network, *, stop: threading.Event | None = None) -> None:
    """Load a network and try it, before hours of other work.

    Raises:
        InputError: it cannot be used.
        Cancelled: `stop` was set.
    """
    _called("try_network", network, {}, stop, None)


def network_masks(
    views: Views,
    model: SparseModel,
    network: Network,
    progress: OnProgress,
    stop: threading.Event | None = None,
) -> Told:
    """Masks of a model's undistorted photos by a network, each photo on its own.

    Needs no plane that the object stands on.

    Raises:
        InputError: the network cannot be used, or finds no object in any photo.
        Cancelled: `stop` was set.
    """
    given = {"views": views, "model": model}
    planes = _called("answers", network, given, stop, progress)
    masks = [_mask(plane, camera) for plane, camera in zip(planes, model.cameras, strict=True)]
    shown = [bool((mask > 0.5).any()) for mask in masks]
    if not any(shown):
        most = max(int(plane.max()) for plane in planes) / 255
        raise InputError(
            f"{network.file}: the network finds no object in any of the {len(masks)} photos: its "
            f"highest probability is {most:.2f}, and 0.5 is expected on the object. Try another "
            'masks.model_input or another network, or go without one: --mask-model ""'
        )
    outlines = outlines_of(model, masks, shown)
    shares = []
    for i, (outline, is_shown) in enumerate(zip(outlines, shown, strict=True)):
        height, width = masks[i].shape
        small = resized(masks[i], *outline.shape[::-1]) > 0.5
        shares.append(_overlap(small, outline))
        if not is_shown:
            masks[i] = resized(outline.astype(np.float32), width, height)
    photos = [views[camera.name].source or camera.name for camera in model.cameras]
    return Told(masks, shares, photos, shown)


def outlines_of(model: SparseModel, masks: list[F32], shown: list[bool]) -> list[Bools]:
    """(h, w) silhouettes of the solid that the masks agree on, photos at most 400 pixels long.

    Args:
        masks: (h, w) in [0, 1] for each camera.
        shown: cameras whose mask is believed.
    """
    shots = [_empty_shot(camera) for camera in model.cameras]
    inside = [resized(m, *shot.whole) > 0.5 for m, shot in zip(masks, shots, strict=True)]
    known = [np.full(m.shape, is_shown) for m, is_shown in zip(inside, shown, strict=True)]
    ball = Ball(model.ball.center, WIDE * model.ball.radius)
    for n, deny in (COARSE, FINE):
        cells = grid(ball, model.up, -np.inf, n)
        free = [
            grown(m, max(1, round(pixels_of(GROWTH * cells.size, shot, ball.center))))
            for m, shot in zip(inside, shots, strict=True)
        ]
        solid = agreed(cells, shots, free, known, model.up, deny=deny)
        if solid.sum() < LEAST_CELLS:
            return [np.zeros(m.shape, bool) for m in inside]
        points = cells.points[solid]
        center = (points.min(0) + points.max(0)) / 2
        reach = float(np.linalg.norm(points - center, axis=1).max())
        ball = Ball(center, reach + 2 * cells.size)
    return [silhouette(cells, solid, shot) for shot in shots]


def _called(
    function: str,
    network: Network,
    given: dict[str, object],
    stop: threading.Event | None,
    progress: OnProgress | None,
) -> list[U8]:
    """Run a function of the network's module in a process of its own."""
    target, arguments = f"{Network.__module__}:{function}", {"network": network, **given}
    try:
        found: list[U8] = call_in_child(target, arguments, stop=stop, on_progress=progress)
    except ChildCrashed as error:
        cause = str(error).partition("\n")[0].partition(" ")[2]
        if "SIGALRM" in cause:
            cause = f"took more than {PHOTO_S} s to load or for one photo"
        raise InputError(
            f"{network.file}: the network {cause}. Give a smaller one, or one that is exported "
            "anew, or a machine with more memory"
        ) from None
    return found


def _mask(plane: U8, camera: Camera) -> F32:
    """(h, w) in [0, 1] with a steep edge where the probability is a half, 1024 pixels long."""
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    share = plane.astype(np.float32) / 255
    if share.shape != (height, width):
        share = np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.asarray((0.5 + STEEP * (share - 0.5)).clip(0, 1), np.float32)


def _empty_shot(camera: Camera) -> Shot:
    """A photo without its pixels: only what it shows matters."""
    scale = min(1.0, LOOK_SIDE / max(camera.width, camera.height))
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    rgb = np.broadcast_to(np.float32(0), (height, width, 3))
    valid = np.ones((height, width), bool)
    return Shot(camera.resized(width, height), rgb, valid, (0, width, 0, height), (width, height))


def _overlap(one: Bools, other: Bools) -> float:
    """Intersection over union; 0 where both are empty."""
    union = int((one | other).sum())
    return float((one & other).sum()) / union if union else 0.0


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (" and others" if len(names) > 3 else "")
