"""How well photos agree on what lies below a lid: the lid itself, or the inside of a vessel.

Rays through a level top end on it if it is a lid, and on the walls or the floor below it if it is
the mouth of a vessel. Rays of several photos that end at one place should have one colour. This is
compared for the closed solid, and for vessels with walls of even thickness and floors at several
depths. Silhouettes bulge on a flat lid, so it is also tried as high as its rim. Reflections spoil
agreement in all of them, so only their ratio counts: a hollow that is there explains differences
that no colour of the lid does. Each photo is compared with the mean of the others, from all sides.
If only its neighbours counted, the virtual image in a dome of gloss would look like a floor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from refdgs_pipe.camera import F64
from refdgs_pipe.training.initial import Hull
from refdgs_pipe.training.photos import TrainingPhoto, shrunk
from refdgs_pipe.training.vessels import Mouth, Plateau, looking_in, shown

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

SIDE = 200  # pixels of the photos that are compared: about one for a cell
MOST = 60  # photos that are compared
SHALLOW = 6.0  # cells below the rim, where the first floor is tried: too shallow for a vessel
STEP = 3.0  # cells between the floors that are tried
PLACE = 2  # cells along the side of a place
VIEWS = 4  # photos that show a place, at least
RAYS = 200  # that all solids explain, at least
STRIDE = 0.5  # cells, along a ray
TIE = 0.02  # of the closed solid's difference: floors that differ by less count as equal
LOW = 1.1  # of the best vessel's differences: of floors that leave less, the lowest is taken
OPENS = 0.8  # of the closed solid's difference, that a vessel leaves at most


@dataclass(frozen=True)
class Below:
    """How well the best vessel explains what is seen through a lid.

    Args:
        ratio: squared differences between photos that it leaves, by those of the closed solid.
        depth: of its floor below the rim, cells.
        vessel: the solid with this hollow.
    """

    ratio: float
    depth: float
    vessel: Hull

    @property
    def opens(self) -> bool:
        """Whether the lid is a mouth."""
        return self.ratio < OPENS and self.depth > SHALLOW

    @property
    def words(self) -> str:
        """The figures, for people."""
        return f"a hollow {self.depth:.0f} cells deep leaves {self.ratio:.0%} of the differences"


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of photos: origins and unit directions (N, 3), colours (N, 3), photo numbers (N,)."""

    origins: F64
    directions: F64
    colors: F64
    photos: Ints

    def where(self, use: Bools) -> "_Rays":
        return _Rays(self.origins[use], self.directions[use], self.colors[use], self.photos[use])


def seen_below(
    photos: Sequence[TrainingPhoto],
    closed: Hull,
    hull: Hull,
    mouth: Mouth,
    plateau: Plateau,
    grounded: Bools,
    progress: Callable[[int, int], None] | None = None,
) -> Below | None:
    """Compare the closed solid with vessels below its lid; None where photos do not tell.

    Args:
        closed: the solid that the lid belongs to; hull: what carving left of it.
        plateau: the level part of the lid, as high as its rim.
        grounded: (n, n, n) cells on the ground or below, in which no hollow reaches.
        progress: told the floors that were tried and their number; may raise.
    """
    up = plateau.normal
    found = _through(photos, closed, mouth, up)
    rim = float((plateau.points @ up).mean())
    if found is None or rim > (mouth.lid @ up).max():  # something stands on the lid
        return None
    rays, along = found
    under = (rim - hull.heights(up)) / hull.cell
    hollow = mouth.hollow & ~grounded
    deepest = under[hollow].max(initial=0)
    depths = np.arange(SHALLOW, deepest + STEP, STEP)
    lids = (hull.cells, hull.cells & ~plateau.bulge)
    closed_by = [_Explained.by(hull, cells, rays, along) for cells in lids]

    def down_to(depth: float) -> Below | None:
        cells = hull.cells & ~(hollow & (under < depth))
        vessel = _Explained.by(hull, cells, rays, along)
        ratios = [ratio for lid in closed_by if (ratio := vessel.ratio_to(lid)) is not None]
        return Below(max(ratios), depth, replace(hull, cells=cells)) if ratios else None

    told = []
    for number, depth in enumerate(depths):
        if progress is not None:
            progress(number, len(depths))
        if (below := down_to(float(depth))) is not None:
            told.append(below)
    if not told:
        return None
    best = min(below.ratio for below in told)
    lowest = [below for below in told if below.ratio <= best + TIE][-1]
    if not lowest.opens:
        return lowest
    most = min(max(best + TIE, best * LOW), OPENS)
    lowest = [below for below in told if below.ratio < most][-1]
    for depth in np.arange(lowest.depth + 1, min(lowest.depth + STEP, deepest + 1)):
        deeper = down_to(float(depth))
        if deeper is None or deeper.ratio >= most:
            break
        lowest = deeper
    return lowest


def _through(
    photos: Sequence[TrainingPhoto], closed: Hull, mouth: Mouth, up: F64
) -> tuple[_Rays, F64] | None:
    """The rays through a lid, and where they start before it (N,); None for too few photos."""
    looks = looking_in(photos, mouth, up)
    if not len(looks):
        return None
    looks = looks[np.unique(np.linspace(0, len(looks) - 1, MOST).round().astype(int))]
    rays = _rays([photos[i] for i in looks], mouth.lid)
    top = np.zeros_like(closed.cells)
    top[tuple(closed.cells_at(mouth.lid).T)] = True
    start = np.linalg.norm(rays.origins - closed.ball.center, axis=1) - 2 * closed.ball.radius
    first, along = _first(closed, closed.cells, rays, np.maximum(start, 0))
    through = (first >= 0) & binary_dilation(top).ravel()[first]
    return (rays.where(through), along[through] - closed.cell) if through.any() else None


@dataclass(frozen=True, eq=False)
class _Explained:
    """How far each ray's colour (N,) is from what other photos show there, squared, where known."""

    squared: F64
    known: Bools

    @classmethod
    def by(cls, hull: Hull, cells: Bools, rays: _Rays, along: F64) -> "_Explained":
        """By a solid: a place's colour is the mean of the other photos' means there."""
        n = len(hull.ticks)
        ends, _ = _first(hull, cells, rays, along)
        i, j, k = (axis // PLACE for axis in np.unravel_index(np.maximum(ends, 0), (n, n, n)))
        place = (i * n + j) * n + k
        _, pair = np.unique(place * (rays.photos.max() + 1) + rays.photos, return_inverse=True)
        of_pair = np.zeros(pair.max() + 1, np.int64)
        of_pair[pair] = place
        color = _means(pair, rays.colors)
        _, group, views = np.unique(of_pair, return_inverse=True, return_counts=True)
        count = views[group][:, None]
        others = (_means(group, color)[group] * count - color) / np.maximum(count - 1, 1)
        squared = ((rays.colors - others[pair]) ** 2).sum(1)
        return cls(squared, (ends >= 0) & (views[group] >= VIEWS)[pair])

    def ratio_to(self, other: "_Explained") -> float | None:
        """Its squared differences by another's, over the rays that both know; None for few."""
        both = self.known & other.known
        if both.sum() < RAYS:
            return None
        return float(self.squared[both].sum() / max(float(other.squared[both].sum()), 1e-9))


def _means(groups: Ints, values: F64) -> F64:
    """(G, C) means of values (N, C) in each group; groups: (N,) in [0, G), none of them empty."""
    sums = np.stack([np.bincount(groups, values[:, c]) for c in range(values.shape[1])], 1)
    return np.asarray(sums / np.bincount(groups)[:, None])


def _rays(photos: Sequence[TrainingPhoto], lid: F64) -> _Rays:
    """The rays of small photos through the pixels that show a lid (N, 3), within their masks."""
    parts = []
    for number, photo in enumerate(photos):
        small = shrunk(photo, SIDE / max(photo.camera.width, photo.camera.height))
        camera = small.camera
        assert small.mask is not None
        there = shown(camera, lid) & (small.mask > 127).numpy()
        towards = camera.pixel_rays()[there] @ camera.cam_from_world[:3, :3]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        color = small.rgb.numpy().transpose(1, 2, 0)[there] / 255.0
        count = len(towards)
        origins = np.tile(camera.center, (count, 1))
        parts.append((origins, towards, color, np.full(count, number)))
    return _Rays(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _first(hull: Hull, cells: Bools, rays: _Rays, along: F64) -> tuple[Ints, F64]:
    """The first of a solid's cells on each ray, as an index (N,), -1 for none; and how far it is.

    Args:
        along: (N,) world units from the origin, where each ray starts.
    """
    n = len(hull.ticks)
    found, along = np.full(len(along), -1), along.copy()
    live = np.arange(len(along))
    for _ in range(int(4 * hull.ball.radius / (STRIDE * hull.cell))):
        points = rays.origins[live] + rays.directions[live] * along[live, None]
        at = hull.cells_at(points)
        index = np.ravel_multi_index(tuple(at.clip(0, n - 1).T), (n, n, n))
        hit = ((at >= 0) & (at < n)).all(1) & cells.ravel()[index]
        found[live[hit]] = index[hit]
        live = live[~hit]
        if not len(live):
            break
        along[live] += STRIDE * hull.cell
    return found, along
