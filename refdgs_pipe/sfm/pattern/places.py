"""Photos of an object on a ground that repeats, placed by that ground.

Checks, tiles and dots mislead features: their matches agree on places that are one period off.
Here the repeats give each photo's camera over the ground, up to quarter turns and whole periods.
What does not repeat (stains, threads, shadows) and features beside the ground (object, room) tell
which of these it is. All photos together have to say so clearly.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.files.images import read_png
from refdgs_pipe.mat.detection import Seen, eight_bit_grey
from refdgs_pipe.sfm.mat_pose import posed_on_plane
from refdgs_pipe.sfm.pattern.beside import features_beside
from refdgs_pipe.sfm.pattern.cells import shared_cell, turn
from refdgs_pipe.sfm.pattern.graph import Laid, laid_out
from refdgs_pipe.sfm.pattern.lattice import Lattice, find_lattice, mapped
from refdgs_pipe.sfm.pattern.pairs import Evidence, Prepared, evidence, prepared
from refdgs_pipe.sfm.pattern.topview import (
    CELL_PX,
    SMALLER,
    U8,
    cell_in_photo,
    gram,
    refined,
    residual,
    settled,
)
from refdgs_pipe.sfm.poses import Poses, Shots

TRIED = 6  # photos that tell whether the ground repeats
LEAST_SHARE = 0.5  # of the photos with a lattice
SPAN_DEG = 120.0
SQUARE = 0.06  # of the sides and of their angle: so far a lattice is square
WITHOUT_EXIF = 1.2  # focal length by the long side
ALL_PAIRS = 60  # photos: up to so many, each is compared with each
NEIGHBOURS = 20  # of more, each with so many next in the order of the files, and with some others


@dataclass(frozen=True)
class _Ground:
    """A photo's view of the ground."""

    file: str
    grey: U8
    lattice: Lattice


def ground_repeats(folder: Path, shots: tuple[Shots, ...], threads: int) -> bool:
    """Whether half of some photos show a lattice.

    Args:
        folder: holds the PNGs that `shots` name.
    """
    files = sorted(file for group in shots for file in group.files)
    tried = files[:: max(1, len(files) // TRIED)][:TRIED]
    return len(_lattices(folder, tried, threads)) >= LEAST_SHARE * len(tried)


def placed_by_pattern(
    folder: Path, shots: tuple[Shots, ...], threads: int, told: Callable[[int, int], None]
) -> Poses | None:
    """Place the photos by a ground that repeats; None where it tells too little.

    Only photos through the lens that most were taken with are placed. Poses are in periods of the
    pattern, z up, the ground at 0; points are repeats on the ground.

    Args:
        folder: holds the PNGs that `shots` name.
        told: hears how many pairs of photos are done, of how many.
    """
    group = max(shots, key=lambda one: len(one.files))
    files = sorted(group.files)
    least = max(3, LEAST_SHARE * len(files))
    inverse = np.asarray(np.linalg.inv(_intrinsics(group)), np.float64)
    grounds = _settled(_lattices(folder, files, threads), inverse)
    if len(grounds) < least:
        return None
    cell = _cell(grounds)
    shared = shared_cell([g.lattice for g in grounds], [g.grey for g in grounds], inverse, cell)
    if shared is None or len(shared.lattices) < least:
        return None
    grounds = [
        _Ground(grounds[k].file, grounds[k].grey, shared.lattices[k]) for k in shared.lattices
    ]
    metric = _metric(grounds, inverse)
    is_square = bool(np.abs(metric - np.eye(2)).max() < SQUARE)
    metric = np.eye(2) if is_square else metric
    offsets = {k: by for k, by in shared.offsets.items() if is_square or k % 2 == 0}
    alone = _posed(grounds, {k: Laid(0, np.zeros(2)) for k in range(len(grounds))}, metric, group)
    if alone is None:
        return None
    grounds = [g for g in grounds if g.file in alone.cam_from_world]
    if len(grounds) < least:
        return None
    photos = [_prepared(g, alone, shared.median, tuple(offsets), threads) for g in grounds]
    middles = np.stack([photo.middle for photo in photos])
    laid = laid_out(middles, _compared(photos, offsets, threads, told), offsets)
    if len(laid) < least:
        return None
    poses = _posed(grounds, laid, metric, group)
    return poses if poses is not None and _span(poses) > SPAN_DEG else None


def _lattices(folder: Path, files: Iterable[str], threads: int) -> list[_Ground]:
    def look(file: str) -> _Ground | None:
        grey = eight_bit_grey(read_png(folder / file), "srgb")
        found = find_lattice(grey)
        return None if found is None else _Ground(file, grey, found)

    with ThreadPoolExecutor(max(1, threads)) as pool:
        return [ground for ground in pool.map(look, files) if ground is not None]


def _settled(grounds: list[_Ground], inverse: F64) -> list[_Ground]:
    """The same, their cells one period, fitted to all cells that look alike.

    Args:
        inverse: (3, 3) of the intrinsics.
    """
    settled_ = [_Ground(g.file, g.grey, settled(g.lattice, g.grey, inverse)) for g in grounds]
    if not settled_:
        return []
    cell = _cell(settled_)
    return [_Ground(g.file, g.grey, refined(g.lattice, g.grey, cell)) for g in settled_]


def _cell(grounds: list[_Ground]) -> int:
    """Pixels of a cell from above, the same for all photos."""
    side = float(np.median([cell_in_photo(g.lattice) for g in grounds])) / SMALLER
    return int(np.clip(round(side), *CELL_PX))


def _intrinsics(group: Shots) -> F64:
    focal = group.focal or WITHOUT_EXIF * max(group.width, group.height)
    return np.array([[focal, 0, group.width / 2], [0, focal, group.height / 2], [0, 0, 1.0]])


def _metric(grounds: list[_Ground], inverse: F64) -> F64:
    """(2, 2) columns are the basis on the plane; the first is (1, 0)."""
    grams = np.stack([gram(g.lattice, inverse) for g in grounds])
    grams /= grams[:, :1, :1]
    middle = np.median(grams, axis=0)
    across = float(middle[0, 1])
    along = float(np.sqrt(max(middle[1, 1] - across**2, 1e-6)))
    return np.array([[1.0, across], [0.0, along]])


def _prepared(
    ground: _Ground, alone: Poses, median: F64, turns: tuple[int, ...], threads: int
) -> Prepared:
    """A photo, ready to be compared.

    Args:
        alone: each photo's place over its own cells; median: (cell, cell) of all cells.
    """
    view = residual(ground.lattice, ground.grey, median)
    lens = alone.lenses[alone.lens_of[ground.file]]
    beside = features_beside(
        ground.grey,
        ground.lattice.pixels_from_cells,
        view,
        Lens(*opencv_lens(lens[0], lens[3])),
        np.asarray(alone.cam_from_world[ground.file], np.float64),
    )
    return prepared(view, np.median(ground.lattice.nodes, axis=0), beside, turns, threads)


def _compared(
    photos: list[Prepared],
    offsets: dict[int, F64],
    threads: int,
    told: Callable[[int, int], None],
) -> dict[tuple[int, int], Evidence]:
    count = len(photos)
    stride = max(1, count // NEIGHBOURS)
    pairs = [
        (a, b)
        for a, b in combinations(range(count), 2)
        if count <= ALL_PAIRS or b - a <= NEIGHBOURS or (b - a) % stride == 0
    ]
    found = {}
    for done, (a, b) in enumerate(pairs):
        if done % 20 == 0:
            told(done, len(pairs))
        found[a, b] = evidence(photos[a], photos[b], offsets, threads)
    return found


def _span(poses: Poses) -> float:
    """Degrees of the circle round the ground's normal that the photos look from: 360 without the
    widest gap.

    What moves with the camera (the object's outline, a lens that bends) lays photos on each other
    as if all looked from one side: with quarter turns, from within 90 degrees.
    """
    around = np.sort(
        [np.degrees(np.arctan2(p[2, 1], p[2, 0])) for p in poses.cam_from_world.values()]
    )
    return 360.0 - float(np.diff(around, append=around[0] + 360).max())


def _posed(
    grounds: list[_Ground], laid: dict[int, Laid], metric: F64, group: Shots
) -> Poses | None:
    """Poses of the photos that lie on each other, and the whole cells that they see.

    A photo's nodes may stand on dark checks, another's on light ones. So each node is moved to the
    nearest whole cell of the common ground, as the photo's homography says.
    """
    seen, corners = {}, {}
    index: dict[tuple[int, int], int] = {}
    for k, place in laid.items():
        lattice, back = grounds[k].lattice, turn(place.turns).T
        whole = np.round(lattice.nodes @ back + place.shift)
        there = (whole - place.shift) @ back.T
        moved = mapped(lattice.pixels_from_cells, there)
        moved += lattice.pixels - mapped(lattice.pixels_from_cells, lattice.nodes)
        ids = [index.setdefault((int(x), int(y)), len(index)) for x, y in whole]
        seen[grounds[k].file] = Seen("a4", np.array(ids, np.int64), moved[:, None])
    for (x, y), number in index.items():
        flat = metric @ np.array([x, y], float)
        corners[number] = np.array([[flat[0], -flat[1], 0.0]])
    return posed_on_plane(seen, group, corners)
