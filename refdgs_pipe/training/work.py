"""What the steps of a run cost, for the time that is left."""

import itertools

from refdgs_pipe.training.settings import TrainParams

# What a step costs, measured on the scenes of docs/performance.md, in parts of a full one
PIXEL_COST, SURFEL_COST, REFLECT_COST, LOCAL_COST = 0.3, 0.2, 0.35, 0.15


def share_behind(
    p: TrainParams, reflect_from: float, position: float, skipped: float = 0.0
) -> float:
    """The share of the run's time that should be behind, from what its phases cost.

    Args:
        reflect_from, position: fractions of the run.
        skipped: what was left out before `anneal_from`; it counts neither as behind nor as ahead.
    """
    edges = sorted({0.0, 1.0, p.coarse_until, reflect_from, p.local_from})
    skip = (p.anneal_from - skipped, p.anneal_from)
    behind = whole = 0.0
    for start, end in itertools.pairwise(edge for edge in edges if edge <= 1):
        pixels = p.coarse**2 if start < p.coarse_until else 1.0
        cost = SURFEL_COST + PIXEL_COST * pixels
        if p.reflection and start >= reflect_from:
            cost += REFLECT_COST * pixels
            cost += LOCAL_COST * pixels * (p.local == "dual" and start >= p.local_from)
        left_out = max(0.0, min(end, skip[1]) - max(start, skip[0])) if skipped else 0.0
        whole += cost * (end - start - left_out)
        behind += cost * (max(0.0, min(end, position) - start) - left_out)
    return min(1.0, max(0.0, behind / whole))
