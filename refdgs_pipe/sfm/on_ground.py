"""Poses refined on the ground that the object stands on, and photos that it gives a place."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.sparse_model import Lost, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera, Lens
from refdgs_pipe.ground.anew import placed_anew
from refdgs_pipe.ground.gains import gains_of
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.register import registered
from refdgs_pipe.sfm.gate import Judgement, with_places
from refdgs_pipe.sfm.posed import shots_of
from refdgs_pipe.sfm.support import support_plane

AROUND, SHOWS = 1.5, 0.3  # ball radii, and share of that ground that a photo has to show
GRID = 32  # places along an edge of it
DENIED = "the ground that the other photos show is not where its place would show it"
OFF = 0.005  # of a photo's longer side: a sparse point that is farther off is not what it shows

Told = Callable[[str, int, int], None]
"""Told what is done, the steps done and their number; may raise."""


@dataclass(frozen=True)
class Laid:
    """What the ground told.

    Args:
        model: with the new poses, lenses and photos.
        refined: photos whose poses were refined; before, after: median distance of the ground's
            texture from where they show it, px of a photo of 800 px.
        anew: names of photos that the ground gave a place, or another one.
        denied: names of photos that had a place, and lost it.
    """

    model: SparseModel
    refined: int
    before: float
    after: float
    anew: tuple[str, ...]
    denied: tuple[str, ...]

    def figures(self) -> list[tuple[str, float | int | str]]:
        """(name, value) of what there is to know at a glance."""
        return [
            ("poses refined on the ground plane", f"{self.refined} of {len(self.model.cameras)}"),
            (
                "distance from the ground's texture",
                f"{self.before:.2f} px, then {self.after:.2f} px",
            ),
            ("photos placed by the ground's texture", len(self.anew)),
            ("photos whose place the ground's texture denies", len(self.denied)),
        ]


def laid_on_ground(views: Views, model: SparseModel, told: Told, threads: int = 1) -> Laid | None:
    """Refine the poses, and place photos that are lost or do not fit; None without such a ground.

    A photo that should show the ground, but in which nothing of its texture is found, has no place
    if the ground gives it none: structure from motion was deceived, as by mirror images.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    if plane is None:
        return None

    def refining(done: int, total: int) -> None:
        told("refining poses on the ground plane", done, total)

    found = registered(views, model, plane.at, refining, threads)
    if found is None:
        return None
    before, after = np.median(list(found.misses.values()), axis=0)
    model = found.model
    unfit = {camera.name: camera for camera in model.cameras if camera.name not in found.misses}
    lost, lenses = _lost(views, model)

    def placing(done: int, total: int) -> None:
        told("placing photos by the ground's texture", done, total)

    known = replace(model, lenses=model.lenses | lenses)
    anew = (
        placed_anew(views, known, plane.at, unfit | lost, placing, threads) if unfit | lost else {}
    )
    model = _with(
        known, {n: replace(c, cam_from_world=anew[n]) for n, c in lost.items() if n in anew}
    )
    model = _moved(model, {name: pose for name, pose in anew.items() if name in unfit})
    denied = [
        name
        for name, camera in unfit.items()
        if name in found.unseen and name not in anew and _should_show(camera, model, plane.at)
    ]
    model = _without(model, denied)
    return Laid(model, len(found.misses), float(before), float(after), tuple(anew), tuple(denied))


def judged_on_ground(
    views: Views,
    placement: Placement,
    judgement: Judgement,
    told: Told,
    *,
    least: float,
    threads: int = 1,
) -> tuple[Judgement, Laid | None]:
    """The judgement after the ground was asked, where it can change it; and what the ground told.

    Args:
        least: share of the photos that must have a trusted place.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    if not judgement.may_be_trusted or judgement.model is None:
        return judgement, None
    laid = laid_on_ground(views, judgement.model, told, threads)
    if laid is None:
        return judgement, None
    return with_places(judgement, views, placement, laid.model, least=least), laid


def evened(views: Views, model: SparseModel, threads: int = 1) -> SparseModel:
    """The model with each photo's factors for exposure and white balance, where they differ.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    if views.background == "removed":
        return model
    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    gains = {} if plane is None else gains_of(views, model, plane.at, threads)
    return replace(model, gains=gains)


def _should_show(camera: Camera, model: SparseModel, plane: tuple[F64, float]) -> bool:
    """Whether a camera would show the ground round the object, or lies below it."""
    ground = Ground.under(model.ball, *plane, AROUND * model.ball.radius)
    if ground.height(camera.center) < 0:
        return True
    picture = np.ones((camera.height, camera.width), np.float32)
    return bool(np.isfinite(ground.flattened(picture, camera, GRID)).mean() >= SHOWS)


def _without(model: SparseModel, names: list[str]) -> SparseModel:
    """The model with photos whose place the ground denies."""
    cameras = tuple(camera for camera in model.cameras if camera.name not in names)
    return replace(
        model,
        cameras=cameras,
        lenses={name: lens for name, lens in model.lenses.items() if name not in names},
        tracks={name: track for name, track in model.tracks.items() if name not in names},
        lost=(*model.lost, *(Lost(name, DENIED) for name in names)),
    )


def _lost(views: Views, model: SparseModel) -> tuple[dict[str, Camera], dict[str, Lens]]:
    """Cameras and lenses of photos without a place, from placed photos of the same camera."""
    placed = {camera.name: camera for camera in model.cameras}
    cameras, lenses = {}, {}
    for shots in shots_of(views, {view.name: (view.width, view.height) for view in views.items}):
        names = [file.removesuffix(".png") for file in shots.files]
        like = next((placed[name] for name in names if name in placed), None)
        for name in names:
            if name in placed or like is None:
                continue
            split = views[name].split
            cameras[name] = replace(like, name=name, split=split, cam_from_world=np.eye(4))
            lenses[name] = model.lenses[like.name]
    return cameras, lenses


def _with(model: SparseModel, found: dict[str, Camera]) -> SparseModel:
    """The model with photos that are lost no longer; their sparse points are not known."""
    cameras = sorted((*model.cameras, *found.values()), key=lambda camera: camera.name)
    names = {camera.name for camera in cameras}
    return replace(
        model,
        cameras=tuple(cameras),
        lenses={name: lens for name, lens in model.lenses.items() if name in names},
        tracks=model.tracks | {name: np.zeros(0, np.int64) for name in found},
        lost=tuple(one for one in model.lost if one.name not in found),
    )


def _moved(model: SparseModel, poses: dict[str, F64]) -> SparseModel:
    """The model with other poses. These photos keep the points that lie where they show them.

    Only the old pose tells where that is.
    """
    old = {camera.name: camera for camera in model.cameras}
    model = model.placed(poses)
    tracks = dict(model.tracks)
    for camera in model.cameras:
        if camera.name not in poses:
            continue
        track = tracks[camera.name]
        was, _ = old[camera.name].project(model.points[track])
        now, depth = camera.project(model.points[track])
        near = np.linalg.norm(now - was, axis=1) < OFF * max(camera.width, camera.height)
        tracks[camera.name] = track[near & (depth > 0)]
    return replace(model, tracks=tracks)
