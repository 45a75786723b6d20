"""How all photos lie on one ground, from what each pair of them says.

One pair seldom decides. So photos are added one by one, each where all photos that lie already
say most for it, the clearest first. A photo stays if the others together put it there once more,
clearly; a group stays with the rest only if what crosses between them puts it there clearly.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.cells import turn
from refdgs_pipe.sfm.pattern.pairs import GRID, REACH, SHIFTS, Evidence, starts

F32 = NDArray[np.float32]
Pairs = Mapping[tuple[int, int], Evidence]

DECIDES = 1.5  # times what speaks for the next best place, that has to speak for the best
CONFIRMED = 3  # photos that have to speak for a place on their own,
ALONE = 4.0  # each with a figure above this
ROUNDS = 6


@dataclass(frozen=True)
class Laid:
    """Where a photo's cells lie on the common ground: x = R x_photo + shift."""

    turns: int
    shift: F64


def laid_out(middles: F64, pairs: Pairs, offsets: Mapping[int, F64]) -> dict[int, Laid]:
    """The photos that the others confirm; photo -> its place. The first one's frame is kept.

    Args:
        middles: (n, 2) of each photo's cells; pairs: (a, b) with a < b -> how b may lie on a.
        offsets: quarter turns -> (2,) what a shift is beside whole cells.
    """
    if not pairs:
        return {}
    ground = _Ground(middles, pairs, offsets)
    laid = ground.grown(max(sorted(pairs), key=lambda pair: _lead(pairs[pair]))[0])
    for _ in range(ROUNDS):
        moved = {k: ground.best(ground.total(k, laid)).place for k in laid}
        if all(_same(moved[k], laid[k]) for k in laid):
            break
        laid = moved
    while len(laid) > CONFIRMED:
        doubts = {k: ground.stands(k, laid) for k in laid}
        weakest = min(doubts, key=lambda k: doubts[k])
        if doubts[weakest] >= DECIDES:
            part = ground.loose_part(laid)
            if not part:
                return laid
            laid = {k: place for k, place in laid.items() if k not in part}
        else:
            del laid[weakest]
    return {}


def _same(one: Laid, other: Laid) -> bool:
    return one.turns == other.turns and bool(np.abs(one.shift - other.shift).max() < 0.5)


def _lead(pair: Evidence) -> float:
    """How far the best place is before the next."""
    values = np.concatenate([table.ravel() for table in pair.table.values()])
    second, first = np.partition(values, -2)[-2:]
    return float(first - second)


@dataclass(frozen=True)
class _Best:
    """The place that most speaks for, what speaks for it, and what for the next best."""

    place: Laid
    first: float
    second: float

    @property
    def clearness(self) -> float:
        return self.first / max(self.second, 1e-6) if self.first > 0 else 0.0


class _Ground:
    """What all pairs say. Tables grow from a seed photo, whose frame is the ground's."""

    def __init__(self, middles: F64, pairs: Pairs, offsets: Mapping[int, F64]) -> None:
        self.middles, self.pairs, self.offsets = middles, pairs, offsets
        self.seed = 0

    def grown(self, seed: int) -> dict[int, Laid]:
        """All photos, added one by one to a first."""
        self.seed = seed
        laid = {seed: Laid(0, np.zeros(2))}
        sums = {k: self._empty(k) for k in range(len(self.middles)) if k != seed}
        newest = seed
        while sums:
            for k, total in sums.items():
                self._add(total, k, newest, laid[newest])
            bests = {k: self.best(total) for k, total in sums.items()}
            newest = max(bests, key=lambda k: bests[k].first - bests[k].second)
            laid[newest] = bests[newest].place
            del sums[newest]
        return laid

    def total(self, k: int, laid: Mapping[int, Laid]) -> Evidence:
        """What all laid photos but itself say about a photo's place."""
        total = self._empty(k)
        for other, place in laid.items():
            if other != k:
                self._add(total, k, other, place)
        return total

    def best(self, total: Evidence) -> _Best:
        """The place with the highest figure, and how high the next is."""
        first, second, place = -np.inf, -np.inf, Laid(0, np.zeros(2))
        for k, table in total.table.items():
            top = np.partition(table.ravel(), -2)[-2:]
            if top[1] > first:
                second = max(first, float(top[0]))
                row, column = np.unravel_index(int(table.argmax()), table.shape)
                first, place = float(top[1]), Laid(k, total.start[k] + np.array([column, row]))
            else:
                second = max(second, float(top[1]))
        return _Best(place, first, second)

    def stands(self, k: int, laid: Mapping[int, Laid]) -> float:
        """How clearly the others put a photo where it lies; 0 if elsewhere, or if few say so."""
        best, mine = self.best(self.total(k, laid)), laid[k]
        alone = [
            float(self._pair(other, k, place, mine.turns, mine.shift))
            for other, place in laid.items()
            if other != k
        ]
        few = sum(figure > ALONE for figure in alone) < CONFIRMED
        return 0.0 if few or not _same(best.place, mine) else best.clearness

    def loose_part(self, laid: Mapping[int, Laid]) -> set[int]:
        """The smaller part of the photos beside a cut that does not hold; empty if all hold.

        The cuts are those of the tree of the strongest pairs (Prim 1957). A cut holds if all
        pairs across it together say clearly that its parts lie on each other as they do.
        """
        loosest, part = DECIDES, set[int]()
        for group in self._branches(laid):
            smaller = min(group, set(laid) - group, key=lambda g: (len(g), sorted(g)))
            clear = self._holds(smaller, laid)
            if clear < loosest:
                loosest, part = clear, smaller
        return part

    def _holds(self, part: set[int], laid: Mapping[int, Laid]) -> float:
        """How clearly the pairs across say that a part is not turned or moved as a whole."""
        rest = [k for k in laid if k not in part]
        first = min(part)
        centre = turn(laid[first].turns) @ self.middles[first] + laid[first].shift
        start = starts(centre, centre, self.offsets)
        tables = {k: np.zeros((SHIFTS, SHIFTS), np.float32) for k in start}
        for k, table in tables.items():
            for b in sorted(part):
                moved = GRID + start[k] + turn(k) @ laid[b].shift
                for a in rest:
                    table += self._pair(a, b, laid[a], (k + laid[b].turns) % 4, moved)
        now = float(tables[0][REACH, REACH])  # neither turned nor moved
        tables[0][REACH, REACH] = -np.inf
        other = max(float(table.max()) for table in tables.values())
        return now / max(other, 1e-6) if now > 0 else 0.0

    def _branches(self, laid: Mapping[int, Laid]) -> list[set[int]]:
        """The parts of the photos beside each edge of the tree of the strongest pairs."""
        photos = sorted(laid)
        strength = {
            (a, b): float(self._pair(a, b, laid[a], laid[b].turns, laid[b].shift))
            for i, a in enumerate(photos)
            for b in photos[i + 1 :]
        }
        parent: dict[int, int] = {}
        inside = {photos[0]}
        while len(inside) < len(photos):
            edges = [pair for pair in strength if (pair[0] in inside) != (pair[1] in inside)]
            a, b = max(edges, key=lambda pair: strength[pair])
            a, b = (a, b) if a in inside else (b, a)
            parent[b] = a
            inside.add(b)
        below: dict[int, set[int]] = {k: {k} for k in photos}
        for k in reversed(list(parent)):  # a photo was added after its parent
            below[parent[k]] |= below[k]
        return [below[k] for k in parent]

    def _empty(self, k: int) -> Evidence:
        start = starts(self.middles[self.seed], self.middles[k], self.offsets)
        return Evidence(start, {q: np.zeros((SHIFTS, SHIFTS), np.float32) for q in start})

    def _add(self, total: Evidence, k: int, other: int, place: Laid) -> None:
        for quarters, table in total.table.items():
            table += self._pair(other, k, place, quarters, GRID + total.start[quarters])

    def _pair(self, a: int, b: int, place: Laid, quarters: int, shifts: F64) -> F32:
        """(...) what speaks for b on the ground turned and moved by shifts (..., 2), a lying there
        as it does."""
        relative = (quarters - place.turns) % 4
        moved = (shifts - place.shift) @ turn(place.turns)  # rows times R: R's inverse of each
        if (a, b) in self.pairs:
            return self.pairs[a, b].at(relative, moved)
        if (b, a) in self.pairs:
            back = -relative % 4
            return self.pairs[b, a].at(back, -(moved @ turn(back).T))
        return np.zeros(shifts.shape[:-1], np.float32)
