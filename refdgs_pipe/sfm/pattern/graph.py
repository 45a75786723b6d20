"""How all photos lie on one ground, from how pairs of them lie on each other.

A pair counts where its best fit stands out. The strongest pairs lay the photos out; then each photo
moves to where most of its pairs put it, and stays only where enough of them agree.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.pairs import DECIDES, Overlay, turn

CLOSE = 0.3  # cells between two ideas of the same place
ROUNDS = 10
CONFIRMED = 3  # pairs that have to agree on a photo's place
AGREEING = 0.75  # of its pairs that count


@dataclass(frozen=True)
class Laid:
    """Where a photo's cells lie on the common ground: x = R x_photo + shift."""

    turns: int
    shift: F64


def laid_out(count: int, overlays: Mapping[tuple[int, int], Overlay]) -> dict[int, Laid]:
    """The photos that several others confirm; photo -> its place. The first one's frame is kept
    up to a turn and a shift.

    Args:
        count: of photos; overlays: (a, b) with a < b -> how b lies on a.
    """
    ties = {pair: o for pair, o in overlays.items() if o.ratio > DECIDES}
    laid = _spanned(count, ties)
    for _ in range(ROUNDS):
        moved = {k: _voted(k, laid, ties) or place for k, place in laid.items()}
        if all(_same(moved[k], laid[k]) for k in laid):
            break
        laid = moved
    while True:
        weak = {k: _doubt(k, laid, ties) for k in laid}
        worst = max(weak, key=lambda k: weak[k], default=None)
        if worst is None or weak[worst] <= 0:
            break
        del laid[worst]
    return _evened(laid, ties)


def _from(
    a: int, b: int, laid: Mapping[int, Laid], ties: Mapping[tuple[int, int], Overlay]
) -> Laid:
    """Where photo b lies, as photo a and their pair say."""
    if (a, b) in ties:
        tie = ties[a, b]
        turns, shift = tie.turns, tie.shift
    else:
        tie = ties[b, a]
        turns = -tie.turns % 4
        shift = -turn(turns) @ tie.shift
    place = laid[a]
    return Laid((place.turns + turns) % 4, turn(place.turns) @ shift + place.shift)


def _same(one: Laid, other: Laid) -> bool:
    return one.turns == other.turns and bool(np.abs(one.shift - other.shift).max() < CLOSE)


def _partners(
    k: int, laid: Mapping[int, Laid], ties: Mapping[tuple[int, int], Overlay]
) -> list[int]:
    return [o for o in laid if o != k and (min(o, k), max(o, k)) in ties]


def _spanned(count: int, ties: Mapping[tuple[int, int], Overlay]) -> dict[int, Laid]:
    """The largest set of photos that pairs join, laid out along the strongest (Prim 1957)."""
    best: dict[int, Laid] = {}
    left = set(range(count))
    while left:
        start = max(left, key=lambda k: (sum(k in pair for pair in ties), -k))
        laid = {start: Laid(0, np.zeros(2))}
        while True:
            edges = [p for p in ties if (p[0] in laid) != (p[1] in laid)]
            if not edges:
                break
            a, b = max(edges, key=lambda p: ties[p].ratio)
            a, b = (a, b) if a in laid else (b, a)
            laid[b] = _from(a, b, laid, ties)
        left -= set(laid)
        best = max(best, laid, key=len)
    return best


def _voted(
    k: int, laid: Mapping[int, Laid], ties: Mapping[tuple[int, int], Overlay]
) -> Laid | None:
    """Where most of a photo's pairs put it, each as strong as its fit stands out."""
    said = [
        (_from(o, k, laid, ties), ties[min(o, k), max(o, k)].ratio - 1)
        for o in _partners(k, laid, ties)
    ]
    if not said:
        return None
    return max(said, key=lambda one: sum(w for place, w in said if _same(place, one[0])))[0]


def _doubt(k: int, laid: Mapping[int, Laid], ties: Mapping[tuple[int, int], Overlay]) -> float:
    """How much speaks against a photo's place; 0 or less where it is confirmed."""
    partners = _partners(k, laid, ties)
    agree = sum(_same(_from(o, k, laid, ties), laid[k]) for o in partners)
    if agree < CONFIRMED:
        return 2.0 - agree / CONFIRMED
    return AGREEING - agree / len(partners)


def _evened(laid: dict[int, Laid], ties: Mapping[tuple[int, int], Overlay]) -> dict[int, Laid]:
    """The same with shifts that fit all agreeing pairs best, by least squares."""
    photos = sorted(laid)
    row = {k: i for i, k in enumerate(photos)}
    lines, values = [], []
    for a, b in ties:
        if a in laid and b in laid and _same(_from(a, b, laid, ties), laid[b]):
            line = np.zeros(len(photos))
            line[row[b]], line[row[a]] = 1.0, -1.0
            lines.append(line)
            values.append(turn(laid[a].turns) @ ties[a, b].shift)
    if not lines:
        return laid
    found = np.linalg.lstsq(np.stack(lines), np.stack(values), rcond=None)[0]
    return {k: Laid(laid[k].turns, found[row[k]]) for k in photos}
