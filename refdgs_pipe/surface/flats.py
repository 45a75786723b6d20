"""Flat parts of a mesh, made flat.

Outlines hold the edges of a flat wall, but not its middle: no camera stands in the wall's plane, so
the solid that all outlines allow bulges there. Where the wall also mirrors, colours do not tell
where it lies. Such a part gets the plane that its outlines allow: it bounds the surface from
outside, so the plane lies along the lower side of the places that outlines hold.

A part counts as flat if it is nearly plane already, if the surface bends away all around it, if
the views' colours do not determine the depth of most of it, and if outlines hold some of it, or
colours do, as those of the print on a plain face.

Where all cameras look down on a flat part, the solid that the outlines allow bulges on it as
steeply as the lowest camera looks. Such a bulge is no longer nearly plane. It becomes one if views
agree far better on what a plane would mirror than on what the bulge would.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.mirrored import STANDS_OUT, Glimpse, Room, best_agreement, mirror_misfits
from refdgs_pipe.surface.net import Net, pieces_of, plane_of
from refdgs_pipe.surface.silhouettes import MOST, spread_evenly

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

TILT = np.cos(np.radians(12.0))  # between a place's normal and the plane's
NEAR = 1.5  # limits that a place of the part may lie off its plane
BULGE_TILT, BULGE_NEAR = np.radians(20.0), 5.0  # the same, of a bulge on a mirror
STEEPER = np.radians(5.0)  # by which it may be steeper than the lowest camera looks on its plane
STEEPEST = np.radians(50.0)
LEAST_AREA = 0.05  # of the mesh's area: outlines alone hold smaller parts well enough
# Root mean square tilt: a strip of a tube that ends at TILT has 6.9 or more, a dome 8.5. Where a
# strip is WIDE, its tube is so wide that it does not bend away at the strip's border.
CURVED, CURVED_WIDE = np.radians(6.5), np.radians(7.5)
WIDE = 0.2  # of the ball's diameter
BEYOND = 0.04  # diameters from the border, within which the surface has to end or be bent
BENT = np.cos(np.radians(25.0))
BENT_SHARE = 0.7  # of the places there
HELD = 0.05  # of an edge's length all round the part: the least that outlines have to hold
SPREAD = 0.5  # of the places that outlines hold, by the part's own
TOLD = 0.05  # of `disagreement`, in views, from which on colours tell the depth
PRINT = 0.15  # the same, from which on they hold a place of a part that is plain elsewhere
INWARDS = 0.75  # weight of places inside the plane; those outside it have the rest
UNHELD = 0.02  # weight of a place that no outline holds, against one outline
GROW_ROUNDS, PLANE_ROUNDS = 6, 12
AGREES = 0.5  # of the bulge's misfit, and of the colours' spread: the most for a plane mirror
TOLD_APART = 0.02  # spread of the mirrored colours, sRGB: what is plainer tells nothing
ENOUGH = 200  # samples that are compared
SEEN = 0.05  # diameters by which the depth that a view shows may differ
_DIRECTIONS, _TOWARDS, _TOWARDS_BULGE = 600, np.cos(np.radians(10.0)), 0.8
_FIRM, _REST = 1e4, 3.0  # of the flat part's place; of the rest's staying


@dataclass(frozen=True)
class Flat:
    """A flat part: the rows (n,) of its vertices, and its plane's point and unit normal."""

    rows: Ints
    center: F64
    normal: F64


@dataclass(frozen=True)
class Mirrored:
    """What views see, to judge what a surface mirrors.

    Args:
        glimpses: of the training cameras.
        center: (3,) of the object ball, world space.
        ground: (3,) unit normal of the ground through the world's origin; None if not known.
    """

    glimpses: Sequence[Glimpse]
    center: F64
    ground: F64 | None = None


def flats_of(
    mesh: TriangleMesh,
    held: F64,
    told: F64,
    *,
    limit: float,
    diameter: float,
    mirrored: Mirrored | None = None,
) -> list[Flat]:
    """The flat parts whose depth only outlines tell: those nearly plane, then bulges on mirrors.

    Args:
        held: (V,) views on whose outline each vertex lies, as from `outline_pull`.
        told: (V,) how much colours tell of its depth, as from `disagreement`.
        limit: as `fit_views` has it, world units; NEAR of it belong to a plane.
        diameter: of the object ball, world units.
        mirrored: without it no bulges are looked for.
    """
    net = Net.of(mesh, diameter)
    held = np.minimum(held, MOST)
    free = np.ones(len(held), bool)
    found = _nearly_plane(net, free, held, told, limit=limit, diameter=diameter)
    if mirrored is not None:
        found += _bulges(net, free, held, told, limit=limit, diameter=diameter, mirrored=mirrored)
    return found


def _nearly_plane(
    net: Net, free: Bools, held: F64, told: F64, *, limit: float, diameter: float
) -> list[Flat]:
    """Parts that are nearly plane, largest first. They are taken from what is `free`."""
    seen = np.zeros(len(held), bool)
    held = held + np.where(told >= PRINT, np.minimum(told, MOST), 0)
    facing = net.smooth @ _directions().T > _TOWARDS
    tried = np.zeros(facing.shape[1], bool)
    least, found = LEAST_AREA * net.area.sum(), []
    while True:
        share = np.where(tried, 0.0, (net.area * free) @ facing)
        best = int(share.argmax())
        if share[best] < least:
            break
        tried[best] = True
        for start in pieces_of(net, free & facing[:, best], least):
            if net.area[start & seen].sum() > 0.5 * net.area[start].sum():
                continue
            part = _grown(net, start, free, NEAR * limit)
            if part is None or net.area[part].sum() < least:
                continue
            seen |= part
            outwards = net.outwards(part)
            if _is_flat(net, part, outwards, held, told, diameter):
                weight = net.area[part] * (held[part] + UNHELD)
                center, normal = _lower_plane(net.points[part], weight, outwards)
                free &= ~part
                found.append(Flat(np.flatnonzero(part), center, normal))
    return found


def _bulges(
    net: Net,
    free: Bools,
    held: F64,
    told: F64,
    *,
    limit: float,
    diameter: float,
    mirrored: Mirrored,
) -> list[Flat]:
    """Bulges that views show to be plane mirrors, largest first; taken from what is `free`.

    Outlines hold a bulge where it ends, so its plane is that of the held places.
    """
    seen = np.zeros(len(held), bool)
    slopes = _steepest(net, mirrored.glimpses)
    facing = net.smooth @ _directions().T > np.cos(_TOWARDS_BULGE * slopes)
    least, found = LEAST_AREA * net.area.sum(), []
    for best in np.argsort(-(net.area * free) @ facing, kind="stable"):
        starts = pieces_of(net, free & ~seen & facing[:, best], least)
        if not starts:
            if net.area[free & facing[:, best]].sum() < least:
                break
            continue
        for start in starts:
            near = BULGE_NEAR * limit * np.tan(slopes[best]) / np.tan(BULGE_TILT)
            part = _grown(net, start, free, float(near), np.cos(slopes[best]))
            if part is None or net.area[part].sum() < least:
                continue
            seen |= part
            firm = part & (held > 0)
            if np.median(told[part]) >= TOLD or not _is_held(net, part, held):
                continue
            outwards = net.outwards(part)
            if _bent_share(net, part, outwards, BEYOND * diameter) < BENT_SHARE:
                continue
            center, normal = _lower_plane(net.points[firm], net.area[firm] * held[firm], outwards)
            as_plane = _mirrored_as_plane(net, part, center, normal, mirrored, diameter)
            if as_plane is not None:
                part &= ~_stands_on(net, part, center, normal, mirrored, *as_plane)
                free &= ~part
                found.append(Flat(np.flatnonzero(part), center, normal))
    return found


def _steepest(net: Net, glimpses: Sequence[Glimpse]) -> F64:
    """(n,) how steep a bulge may be on a flat part that faces each of the directions, radians."""
    towards = np.stack([glimpse.camera.center for glimpse in glimpses]) - net.points.mean(0)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lowest = np.arcsin(np.clip((towards @ _directions().T).min(0), -1, 1))
    return np.asarray(np.clip(lowest + STEEPER, BULGE_TILT, STEEPEST), np.float64)


def _mirrored_as_plane(
    net: Net, part: Bools, center: F64, normal: F64, mirrored: Mirrored, diameter: float
) -> tuple[float, Room | None] | None:
    """The spread of the colours that views see of the plane, sRGB, and the room that it mirrors.

    None if views do not agree far better on the plane than on the part as it is.
    """
    points = net.points[part]
    plane = points - ((points - center) @ normal)[:, None] * normal
    shapes = ((points, net.smooth[part]), (plane, np.tile(normal, (len(plane), 1))))
    (now, _), (flat, room) = (
        best_agreement(
            *shape,
            mirrored.glimpses,
            near=SEEN * diameter,
            center=mirrored.center,
            radius=diameter / 2,
            enough=ENOUGH,
            ground=mirrored.ground,
        )
        for shape in shapes
    )
    if min(now.count, flat.count) < ENOUGH or flat.spread < TOLD_APART:
        return None
    agrees = flat.misfit <= AGREES * min(now.misfit, flat.spread)
    return (flat.spread, room) if agrees else None


def _stands_on(
    net: Net,
    part: Bools,
    center: F64,
    normal: F64,
    mirrored: Mirrored,
    spread: float,
    room: Room | None,
) -> Bools:
    """(V,) what stands on the plane of a part, such as a knob, as `STANDS_OUT` has it.

    Args:
        spread, room: as from `_mirrored_as_plane`.
    """
    rows = np.flatnonzero(part)
    points = net.points[rows] - ((net.points[rows] - center) @ normal)[:, None] * normal
    normals = np.tile(normal, (len(rows), 1))
    misfits = mirror_misfits(points, normals, mirrored.glimpses, near=np.inf, room=room)
    stands = np.zeros(len(part))
    stands[rows] = misfits > STANDS_OUT * spread
    beside = np.asarray(net.beside @ stands) / np.maximum(net.beside.sum(1), 1)
    return np.asarray((stands > 0) & (beside > 0.5))


def flattened(mesh: TriangleMesh, flats: list[Flat]) -> TriangleMesh:
    """The mesh with its flat parts moved onto their planes; what is beside them follows."""
    if not flats:
        return mesh
    points = mesh.vertices.astype(np.float64)
    weight, moved = np.zeros(len(points)), np.zeros_like(points)
    for flat in flats:
        away = (points[flat.rows] - flat.center) @ flat.normal
        moved[flat.rows] = -away[:, None] * flat.normal
        weight[flat.rows] = _FIRM
    links = links_of(mesh.faces)
    for axis in range(3):
        pull = weight * moved[:, axis]
        followed = spread_evenly(weight, pull, links, rest=_REST)
        points[:, axis] += np.where(weight > 0, moved[:, axis], followed)
    return TriangleMesh(points.astype(np.float32), mesh.faces)


def _directions() -> F64:
    """(n, 3) unit vectors, evenly spread (a Fibonacci lattice)."""
    row = np.arange(_DIRECTIONS) + 0.5
    height = 1 - 2 * row / _DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * row
    radius = np.sqrt(1 - height**2)
    return np.stack([np.cos(turn) * radius, np.sin(turn) * radius, height], 1)


def _grown(net: Net, part: Bools, free: Bools, reach: float, tilt: float = TILT) -> Bools | None:
    """The connected vertices near the plane of a part, and turned like it; None for none."""
    for _ in range(GROW_ROUNDS):
        center = np.average(net.points[part], axis=0, weights=net.area[part])
        normal = net.outwards(part)
        near = np.abs((net.points - center) @ normal) < reach
        pieces = pieces_of(net, free & near & (net.smooth @ normal > tilt), 0.0)
        shared = [float(net.area[piece & part].sum()) for piece in pieces]
        if not shared or max(shared) == 0:
            return None
        before, part = part, pieces[int(np.argmax(shared))]
        if (before != part).sum() < 0.01 * part.sum():
            break
    return part


def _is_flat(net: Net, part: Bools, normal: F64, held: F64, told: F64, diameter: float) -> bool:
    """Whether a part is flat by all that is known, and only outlines tell where it lies.

    Args:
        normal: (3,) of its plane, outwards.
    """
    area = net.area[part]
    if np.median(told[part]) >= TOLD or not _is_held(net, part, held):
        return False
    tilt = np.arccos(np.clip(net.smooth[part] @ normal, -1, 1))
    away = net.points[part] - np.average(net.points[part], axis=0, weights=area)
    width = np.sqrt(12 * np.linalg.eigvalsh(np.cov(away.T, aweights=area))[1])
    curved = CURVED_WIDE if width > WIDE * diameter else CURVED
    if np.sqrt(np.average(tilt**2, weights=area)) > curved:
        return False
    return _bent_share(net, part, normal, BEYOND * diameter) >= BENT_SHARE


def _bent_share(net: Net, part: Bools, normal: F64, reach: float) -> float:
    """Share of a part's border from which the surface ends or bends away within the reach."""
    border = np.flatnonzero(part & ((net.beside @ (~part).astype(float) > 0) | net.rim))
    if not len(border):
        return 0.0
    ends = np.flatnonzero((net.smooth @ normal < BENT) | net.rim)
    if not len(ends):
        return 0.0
    away = dijkstra(net.lengths, indices=ends, min_only=True, limit=reach)
    length = np.minimum(np.sqrt(net.area[border]), net.step)
    return float(length @ np.isfinite(away[border]) / length.sum())


def _is_held(net: Net, part: Bools, held: F64) -> bool:
    """Whether outlines hold enough of a part, in both directions, to tell its plane.

    Outlines may hold no more than its border, which is a smaller share of the area the larger the
    part is and the finer the mesh.
    """
    area = net.area[part]
    firm = area * (held[part] > 0)
    border = net.step * 2 * np.sqrt(np.pi * area.sum())  # as if the part were round
    if firm.sum() < HELD * border:
        return False
    away = net.points[part] - np.average(net.points[part], axis=0, weights=area)
    sizes, across = np.linalg.eigh(np.cov(away.T, aweights=area))
    along = away @ across[:, 1:]
    wide = np.average(along**2, axis=0, weights=firm)
    wide -= np.average(along, axis=0, weights=firm) ** 2
    return bool((wide >= SPREAD**2 * sizes[1:]).all())


def _lower_plane(points: F64, weight: F64, outwards: F64) -> tuple[F64, F64]:
    """The plane along the inner side of places that bound a surface from outside.

    An expectile plane (Newey and Powell 1987), with Cauchy's weights against places far from it.

    Args:
        outwards: (3,) a normal that points out of the surface.
    """
    now = weight
    for _ in range(PLANE_ROUNDS):
        center, normal = plane_of(points, now)
        normal = normal * np.sign(normal @ outwards)
        away = (points - center) @ normal
        scale = 0.5 * np.sqrt(np.average(away**2, weights=weight))
        side = np.where(away > 0, 1 - INWARDS, INWARDS)
        now = weight * side / (1 + (away / max(float(scale), 1e-12)) ** 2)
    return center, normal
