"""Where photos are missing round the object, in words."""

from collections.abc import Mapping

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.sfm.around import Around, around

GAP_DEG = 60.0  # between neighbours round the object, from which on a gap is named
ROUND_DEG = 180.0  # photos go round the object if no gap is as wide
LOWEST_DEG = 30.0  # a lowest photo above this height is named
HIGHEST_DEG = 35.0  # a highest photo below this height is named


def gaps_of(model: SparseModel, said: Mapping[str, str]) -> tuple[str, ...]:
    """Sentences on wide gaps between neighbouring photos round the object, widest first, and on
    missing heights.

    Args:
        said: name of a camera -> what the user calls its photo.
    """
    whole = around(model)
    if whole is None or len(whole.directions) < 3:
        return ()
    order = sorted(whole.directions, key=lambda direction: direction.azimuth)
    found = []
    for one, after in zip(order, [*order[1:], order[0]], strict=True):
        gap = (after.azimuth - one.azimuth) % 360.0
        if gap >= GAP_DEG:
            found.append((gap, one.name, after.name))
    gaps = [
        f"between {said[one]} and {said[after]} there is a gap of {gap:.0f} degrees"
        for gap, one, after in sorted(found, reverse=True)
    ]
    return (*gaps, *_missing_heights(whole))


def lowest_height(model: SparseModel) -> float | None:
    """Height of the lowest photo over the horizon through the object, degrees.

    None where photos do not go round the object: they can have any up direction.
    """
    whole = around(model)
    return None if whole is None or whole.gap_deg >= ROUND_DEG else whole.heights[0]


def _missing_heights(whole: Around) -> list[str]:
    """A sentence if photos go round the object, and none is low, or none is high.

    Photos from one side can have any up direction, so heights mean nothing there.
    """
    lowest, highest = whole.heights
    if whole.gap_deg >= ROUND_DEG:
        return []
    if lowest > LOWEST_DEG:
        return [
            f"all photos look down from {lowest:.0f} degrees or more: the shape of a plain top and "
            "of the walls is uncertain. Add a ring of photos from 10 to 20 degrees"
        ]
    if highest < HIGHEST_DEG:
        return [
            f"no photo looks down from more than {highest:.0f} degrees: the shape of the top is "
            "uncertain. Add a ring of photos from 45 to 60 degrees"
        ]
    return []
