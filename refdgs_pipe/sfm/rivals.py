"""Which of two solutions from the same matches the photos bear out.

Where things repeat, the mappers can find two placements that contradict each other, each with most
of the photos. Their numbers of trusted photos say little then: false matches hold a place as well
as right ones. What the photos show decides, where it can: photos that a solution puts close
together have to look alike.
"""

from dataclasses import replace

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm.gate import APART, shows_the_same


def settled(views: Views, solutions: tuple[Poses, ...]) -> Poses:
    """The first solution, or the second where only that one agrees with what the photos show.

    A solution that the photos refute is no evidence against the other: its distance is forgotten.

    Args:
        solutions: one, or two with their distance as `rival`.
    """
    first = solutions[0]
    if len(solutions) == 1 or first.rival is None or first.rival <= APART:
        return first
    found = [shows_the_same(views, poses) for poses in solutions]
    if set(found) != {True, False}:
        return first
    return replace(solutions[found.index(True)], rival=None)
