"""Which light moves, by what the photos show."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import BANDS, Flash, Lighting, Ring, Turntable
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.formatting import counted
from refdgs_pipe.lighting.evidence import (
    F32,
    Ground,
    falloff,
    grey_of,
    looked_up,
    placed_lamp,
    still_share,
)
from refdgs_pipe.lighting.rings import FEWEST, Rings, find_rings

LONGEST = 320  # pixels of the photos that are looked at
IN_RINGS = 0.7  # share of the photos in rings, from which a turntable is possible
STILL_SHARE = 0.25  # of the textured background that stands still, from which it is one
OF_A_LAMP = 0.25  # slope from which the ground is lit by a lamp on the camera
OF_A_WEAK_LAMP = 0.12  # and if EXIF says that the flash fired, or a lamp explains the ground
EXPLAINED = 0.2  # share of the ground's changes that a lamp explains
FIRED = 0.5  # share of the photos whose flash fired
ROOM = {"flash": 0.1, "world+flash": 0.5}  # share of the room's light to begin with
NEAR_GROUND = 0.01  # ball radii
MOST = 24  # photos that are looked at


@dataclass(frozen=True)
class Evidence:
    """What was measured.

    Args:
        rings: of the cameras; None without any.
        still: share of the textured background that stands still.
        ground: what was seen of the ground; None without one. slope, explained: of `falloff`.
        fired: share of the photos whose flash fired by EXIF; None where none says so or not.
    """

    rings: Rings | None
    still: float
    ground: Ground | None
    slope: float | None
    explained: float | None
    fired: float | None


def gather(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float] | None,
    progress: Callable[[int, int], None],
) -> Evidence:
    """Look at the photos, small.

    Args:
        plane: normal (3,) and offset of the ground, world; None without one.
        progress: told the photos done and their number; may raise.
    """
    placed = set(model.names)
    told = [view.exif.flash for view in views.items if view.name in placed]
    known = [fired for fired in told if fired is not None]
    fired = float(np.mean(known)) if known else None
    rings = find_rings(model.cameras, model.ball.center, model.up)
    if views.background != "photo":  # nothing but the object is there
        return Evidence(rings, 0.0, None, None, None, fired)
    may_turn = rings is not None and rings.share >= IN_RINGS
    greys, seen, cameras = {}, {}, {}
    on_ground, points = _on_ground(model, plane), model.points
    chosen = _chosen(model, rings.members if may_turn and rings is not None else ())
    for photo in _photos(views, model, chosen, progress):
        name, grey = photo.camera.name, grey_of(photo.rgb)
        cameras[name] = photo.camera
        if may_turn:
            greys[name] = photo.rgb.mean(2)
        index = model.tracks.get(name, np.zeros(0, np.int64))
        index = index[on_ground[index]]
        at, depth = photo.camera.project(points[index])
        side = np.array([photo.camera.width, photo.camera.height])
        inside = (depth > 0) & (at > 1).all(1) & (at < side - 1).all(1)
        seen[name] = (index[inside], looked_up(grey, at[inside]) if inside.any() else np.zeros(0))
    still = 0.0
    if rings is not None and may_turn:
        still = _stillness(rings, model, greys, cameras)
    ground = None if plane is None else Ground.of(seen, cameras, points, plane[0])
    slope, explained = (None, None) if ground is None else falloff(ground)
    return Evidence(rings, still, ground, slope, explained, fired)


def decide(found: Evidence, model: SparseModel, kind: str) -> Lighting:
    """The lighting of a wanted kind, or by the evidence ("auto").

    A turntable that was asked for and whose axis no ring of photos shows turns about the world's
    up through the object's centre.
    """
    if kind == "world":
        return Lighting("world", "it was set (lighting.kind)")
    if kind in ROOM:
        return _flash(found, model, "it was set (lighting.kind)", ROOM[kind])
    if kind == "turntable":
        table = None if found.rings is None else found.rings.turntable
        table = table or _plain_turntable(model)
        return Lighting("turntable", "it was set (lighting.kind)", turntable=table)
    rings = found.rings
    if rings is not None and rings.share >= IN_RINGS and found.still >= STILL_SHARE:
        reason = (
            f"the cameras form {counted(len(rings.members), 'ring')} about one axis, and "
            f"{found.still:.0%} of the background's texture stands still"
        )
        return Lighting("turntable", reason, turntable=rings.turntable)
    fired = found.fired is not None and found.fired >= FIRED
    if found.slope is None:
        if fired:
            return _flash(found, model, "EXIF says that the flash fired")
        return Lighting("world", "nothing says that it moves")
    lamp = f"the ground darkens away from the camera by {found.slope:.0%} of what a lamp there does"
    explains = found.explained is not None and found.explained >= EXPLAINED
    if found.slope >= (OF_A_WEAK_LAMP if fired or explains else OF_A_LAMP):
        reason = f"{lamp}, and EXIF says that the flash fired" if fired else lamp
        return _flash(found, model, reason)
    if fired:
        return Lighting("world", f"EXIF says that the flash fired, but {lamp}")
    return Lighting("world", "the ground does not darken away from the camera, nor does it turn")


def _flash(
    found: Evidence, model: SparseModel, reason: str, room: float = ROOM["flash"]
) -> Lighting:
    """A lamp where the ground says that it is, or at the lens; factor 1 at the object's distance.

    Args:
        room: share of the room's light where no ground tells it.
    """
    centers = np.stack([camera.center for camera in model.cameras])
    distance = float(np.median(np.linalg.norm(centers - model.ball.center, axis=1)))
    lamp = np.zeros(3)
    if found.ground is not None:
        lamp, room = placed_lamp(found.ground, distance)
    return Lighting("flash", reason, flash=Flash(lamp, distance, room))


def _plain_turntable(model: SparseModel) -> Turntable:
    """About the world's up, through the object, with one ring for all cameras."""
    apart = np.stack([camera.center for camera in model.cameras]) - model.ball.center
    height = apart @ model.up
    radius = np.linalg.norm(apart - height[:, None] * model.up, axis=1)
    ring = Ring(float(np.median(height)), float(np.median(radius)))
    return Turntable(model.ball.center, model.up, (ring,), np.zeros((BANDS, 3)))


def _on_ground(model: SparseModel, plane: tuple[F64, float] | None) -> NDArray[np.bool_]:
    """(P,) the sparse points that lie on the ground."""
    if plane is None:
        return np.zeros(len(model.points), np.bool_)
    heights = model.points @ plane[0] - plane[1]
    return np.asarray(np.abs(heights) < NEAR_GROUND * model.ball.radius)


def _chosen(model: SparseModel, rings: tuple[tuple[int, ...], ...]) -> list[Camera]:
    """Some photos of each ring, or of all: enough to tell, and soon looked at."""
    groups = rings or (tuple(range(len(model.cameras))),)
    most = max(2 * FEWEST, MOST // len(groups))
    picked = (np.unique(np.linspace(0, len(g) - 1, most).round().astype(int)) for g in groups)
    rows = [group[i] for group, some in zip(groups, picked, strict=True) for i in some]
    return [model.cameras[i] for i in rows]


def _photos(
    views: Views,
    model: SparseModel,
    cameras: list[Camera],
    progress: Callable[[int, int], None],
) -> Iterator[Photo]:
    """Those of some cameras, small."""
    for done, camera in enumerate(cameras):
        progress(done, len(cameras))
        scale = min(1.0, LONGEST / max(camera.width, camera.height))
        yield load_photo(views, model, camera, scale=scale)


def _stillness(
    rings: Rings, model: SparseModel, greys: dict[str, F32], cameras: dict[str, Camera]
) -> float:
    """The mean of `still_share` over the rings, by their photos."""
    ball, total, weight = model.ball, 0.0, 0.0
    for ring in rings.members:
        names = [model.cameras[i].name for i in ring if model.cameras[i].name in greys]
        if len(names) < FEWEST or len({greys[name].shape for name in names}) > 1:
            continue
        pictures, lenses = [greys[n] for n in names], [cameras[n] for n in names]
        share = still_share(pictures, lenses, ball.center, ball.radius)
        total, weight = total + share * len(names), weight + len(names)
    return total / max(weight, 1.0)
