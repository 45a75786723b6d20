"""How well views agree on what a surface mirrors.

A mirror shows the same light wherever it reflects rays into the same direction, as long as what it
shows is far away; and where it reflects them to the same place of the ground, or of the walls of a
room. With wrong normals, views disagree on the light from there. So two shapes of a part can be
compared by the pictures alone, although the colours of a mirror tell nothing of its depth.

A matte place has one colour in all views instead. Where neither holds, the surface is not where the
views saw something: it may be a lid over a hollow, or a bulge.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

# Misfit at a place of a plane mirror, by the spread of its colours, from which on something stands
# there: views see that in place of the plane, and it does not move as a reflection does.
STANDS_OUT = 1.0
_LONGEST = 320  # pixels of the pictures that are compared
_ALPHA = 0.9
_FACING = 0.1  # cosine from which a place is seen
_SAME = np.radians(4.0)  # between directions that show the same light
_ASKED = 4000  # samples that are compared with others
_PARTNERS = 5  # samples of other views that a sample is compared with, at least
_REACH = 3.0  # ball radii: ground farther away counts as far
_AWAY = (16.0, 8.0, 4.0)  # ball radii: how far walls may be that are not infinitely far away
_VIEWS = 4  # that have to see a place
_MISFIT = 0.08  # sRGB, of colours that agree
_ASKED_ALL, _COMPARED = 30_000, 60_000
_RINGS, _FEWEST = 2, 8  # of neighbours whose samples count for a vertex; samples, at least
_TURNED = 0.2  # weight of the normals: 20 degrees between them count as _SAME
_APART = 10.0  # between directions and places of the ground, as coordinates


@dataclass(frozen=True)
class Glimpse:
    """A small picture of what one camera sees of the surface.

    Args:
        color: (H, W, 3) sRGB; depth: (H, W) camera z, 0 where there is no surface.
    """

    camera: Camera
    color: F32
    depth: F32

    @classmethod
    def of(cls, view: SurfaceMap) -> "Glimpse":
        """A view made smaller."""
        import cv2

        camera = view.camera.fitted(_LONGEST)
        size = (camera.width, camera.height)
        color = cv2.resize(view.color, size, interpolation=cv2.INTER_AREA)
        there = np.where(view.alpha >= _ALPHA, view.depth, 0)
        depth = cv2.resize(there, size, interpolation=cv2.INTER_NEAREST)
        return cls(camera, color, depth)


@dataclass(frozen=True)
class Room:
    """What a surface mirrors, as if it were a picture on a sphere.

    Args:
        center: (3,) of the sphere, world space; distance: its radius, world units.
    """

    center: F64
    distance: float

    def met(self, points: F64, away: F64) -> F64:
        """(N, 3) unit vectors to where rays from points (N, 3) in it meet it.

        Args:
            away: (N, 3) the rays' unit directions.
        """
        start = (points - self.center) / self.distance
        along = (start * away).sum(1)
        depth = along**2 + 1 - (start**2).sum(1)
        return np.asarray(start + (np.sqrt(np.maximum(depth, 0)) - along)[:, None] * away)


@dataclass(frozen=True)
class _Samples:
    """What views see of points.

    Args:
        point, view: (S,) rows of the points and numbers of the views.
        color: (S, 3) sRGB.
        key: (S, 7) where the mirrored ray goes, as from `_keys`, and how the surface is turned:
            what is turned otherwise is another part, and may be of another material.
    """

    point: Ints
    view: Ints
    color: F64
    key: F64


@dataclass(frozen=True)
class Agreement:
    """How views agree on mirrored light, in sRGB.

    Args:
        misfit: mean difference of a sample from what other views say comes from its direction.
        spread: mean difference of all samples from their median.
        count: samples that other views say something of.
        level: median colour of all samples.
    """

    misfit: float
    spread: float
    count: int
    level: float = 0.0


def mirror_agreement(
    points: F64,
    normals: F64,
    glimpses: Iterable[Glimpse],
    *,
    near: float,
    ground: F64 | None = None,
    radius: float = 1.0,
    room: Room | None = None,
) -> Agreement:
    """How well views agree on the light that a surface would mirror.

    Args:
        points, normals: (N, 3) of the surface, world space; unit normals outwards.
        near: a place is seen where the view's depth is its own but for this, world units.
        ground: (3,) unit normal of the ground through the world's origin, if it is known.
        radius: of the object ball, world units.
        room: what is mirrored beside the ground; None: it is infinitely far away.
    """
    samples = _samples(
        points, normals, glimpses, near=near, ground=ground, radius=radius, room=room
    )
    if not len(samples.key):
        return Agreement(np.nan, 0.0, 0)
    middle = np.median(samples.color, axis=0)
    spread = float(np.abs(samples.color - middle).mean())
    misses = _misses(samples, _ASKED, len(samples.key))[1]
    misfit = float(np.mean(misses)) if len(misses) else float("nan")
    return Agreement(misfit, spread, len(misses), float(middle.mean()))


def best_agreement(
    points: F64,
    normals: F64,
    glimpses: Sequence[Glimpse],
    *,
    near: float,
    center: F64,
    radius: float,
    enough: int,
    ground: F64 | None = None,
) -> tuple[Agreement, Room | None]:
    """How well views agree on the light that a surface would mirror, from whatever distance.

    Few photos see one direction mirrored if they are taken from far apart, and none of them agree
    on directions if walls are near. So rooms of several sizes are tried.

    Args:
        points, normals, glimpses, near, ground: as `mirror_agreement` has them.
        center, radius: of the object ball, world units.
        enough: samples that have to be compared.

    Returns:
        The agreement with the least misfit, and its room (None: infinitely far away). The one with
        the most samples if all have too few.
    """
    tried = []
    for room in (None, *(Room(center, away * radius) for away in _AWAY)):
        found = mirror_agreement(
            points, normals, glimpses, near=near, ground=ground, radius=radius, room=room
        )
        tried.append((found, room))
    told = [one for one in tried if one[0].count >= enough]
    if told:
        return min(told, key=lambda one: one[0].misfit)
    return max(tried, key=lambda one: one[0].count)


def mirror_misfits(
    points: F64,
    normals: F64,
    glimpses: Iterable[Glimpse],
    *,
    near: float,
    room: Room | None = None,
) -> F64:
    """(N,) the misfit of `mirror_agreement` at each point; NaN where nothing can be compared."""
    samples = _samples(points, normals, glimpses, near=near, ground=None, radius=1.0, room=room)
    if not len(samples.key):
        return np.full(len(points), np.nan)
    rows, misses = _misses(samples, _ASKED_ALL, _COMPARED)
    at = samples.point[rows]
    count = np.bincount(at, minlength=len(points))
    total = np.bincount(at, misses, len(points))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def unexplained(
    points: F64,
    normals: F64,
    area: F64,
    links: Ints,
    glimpses: Iterable[Glimpse],
    *,
    near: float,
    ground: F64 | None = None,
    radius: float = 1.0,
) -> float | None:
    """Share of a surface where views agree neither on its colour nor on what it mirrors.

    Args:
        points, normals: (N, 3) its vertices, world space; unit normals outwards.
        area: (N,) of each vertex; links: (E, 2) neighbours.
        near, ground, radius: as `mirror_agreement` has them.

    Returns:
        None where no place is seen by some views.
    """
    samples = _samples(points, normals, glimpses, near=near, ground=ground, radius=radius)
    count = len(points)
    views = np.bincount(samples.point, minlength=count)
    seen = views >= _VIEWS
    if not seen.any():
        return None
    sums = [np.bincount(samples.point, samples.color[:, i], count) for i in range(3)]
    mean = np.stack(sums, 1) / np.maximum(views, 1)[:, None]
    off = np.abs(samples.color - mean[samples.point]).mean(1)
    asked, misses = _misses(samples, _ASKED_ALL, _COMPARED)
    place = _spread(samples.point, off, links, count)
    mirror = _spread(samples.point[asked], misses, links, count)
    bad = seen & (np.fmin(place, mirror) > _MISFIT) & np.isfinite(mirror)
    return float(area[bad].sum() / area[seen].sum())


def _spread(rows: Ints, values: F64, links: Ints, count: int) -> F64:
    """(N,) means of values (S,) of the vertices `rows` (S,), over some rings of neighbours.

    NaN where these have few values: what nothing can be compared with is not judged by others.
    """
    from scipy.sparse import coo_array

    a, b = links.T
    ends = (np.r_[a, b], np.r_[b, a])
    beside = coo_array((np.ones(2 * len(links)), ends), shape=(count, count)).tocsr()
    total = np.asarray(np.bincount(rows, values, count), np.float64)
    number = np.bincount(rows, minlength=count).astype(np.float64)
    for _ in range(_RINGS):
        total, number = total + beside @ total, number + beside @ number
    return np.where(number >= _FEWEST, total / np.maximum(number, 1), np.nan)


def _samples(
    points: F64,
    normals: F64,
    glimpses: Iterable[Glimpse],
    *,
    near: float,
    ground: F64 | None,
    radius: float,
    room: Room | None = None,
) -> _Samples:
    """What all views see of points, and where it would come from by reflection."""
    point, view = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    color, key = [np.zeros((0, 3))], [np.zeros((0, 7))]
    for number, glimpse in enumerate(glimpses):
        rows, seen = _seen(points, normals, glimpse, near)
        toward = points[rows] - glimpse.camera.center
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        facing = (toward * normals[rows]).sum(1, keepdims=True)
        away = toward - 2 * facing * normals[rows]
        keys = _keys(points[rows], away, ground, radius, room)
        key.append(np.concatenate([keys, _TURNED * normals[rows]], axis=1))
        point.append(rows)
        color.append(seen)
        view.append(np.full(len(rows), number))
    return _Samples(
        np.concatenate(point), np.concatenate(view), np.concatenate(color), np.concatenate(key)
    )


def _misses(samples: _Samples, asked: int, compared: int) -> tuple[Ints, F64]:
    """Some samples (A,), and how far each is off what other views say comes from there (A,).

    Args:
        asked: samples that are held against others; compared: samples that these are chosen from.
    """
    random = np.random.default_rng(0)
    chosen = random.permutation(len(samples.key))
    some = chosen[:asked]
    others = np.sort(random.permutation(chosen)[:compared])
    around = cKDTree(samples.key[others]).query_ball_point(samples.key[some], 2 * np.sin(_SAME / 2))
    rows, misses = [], []
    for sample, near in zip(some, around, strict=True):
        partners = others[near]
        partners = partners[samples.view[partners] != samples.view[sample]]
        if len(partners) >= _PARTNERS:
            told = np.median(samples.color[partners], axis=0)
            rows.append(sample)
            misses.append(np.abs(told - samples.color[sample]).mean())
    return np.asarray(rows, np.int64), np.asarray(misses, np.float64)


def _seen(points: F64, normals: F64, glimpse: Glimpse, near: float) -> tuple[Ints, F64]:
    """The points that a view sees, and their colours there."""
    camera = glimpse.camera
    pixels, depth = camera.project(points)
    toward = camera.center - points
    cosine = (toward * normals).sum(1) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    size = np.array([camera.width, camera.height])
    there = (depth > 0) & (cosine > _FACING) & (pixels >= 0).all(1) & (pixels < size).all(1)
    rows = np.flatnonzero(there)
    column, row = pixels[rows].astype(np.int64).T
    front = glimpse.depth[row, column]
    free = (front > 0) & (np.abs(front - depth[rows]) < near)
    return rows[free], glimpse.color[row[free], column[free]].astype(np.float64)


def _keys(points: F64, away: F64, ground: F64 | None, radius: float, room: Room | None) -> F64:
    """(N, 4) coordinates that are near for rays which meet the same: room, or ground.

    Args:
        away: (N, 3) unit directions of the mirrored rays.
    """
    far = away if room is None else room.met(points, away)
    keys = np.concatenate([far, np.zeros((len(away), 1))], axis=1)
    if ground is None:
        return keys
    height, falling = points @ ground, away @ ground
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(falling < 0, -height / falling, np.inf)
    place = points + np.where(np.isfinite(length), length, 0)[:, None] * away
    close = np.isfinite(length) & (np.linalg.norm(place, axis=1) < _REACH * radius)
    keys[close, :3] = place[close] / radius
    keys[close, 3] = _APART
    return keys
