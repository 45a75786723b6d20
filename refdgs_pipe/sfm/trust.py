"""Which photos' places can be trusted, photo by photo, from what their features say.

A photo that the mapper placed is trusted if enough points that three photos see hold it, if these
come from more than one partner, and if less speaks against its place than for it. Where things
repeat, false matches outnumber right ones. So more may speak against a place that many points hold
and that the other photos confirm.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.placement import Evidence, Poses
from refdgs_pipe.camera import center_of
from refdgs_pipe.geometry import robust_similarity
from refdgs_pipe.sfm.cuts import contradicted_group

POINTS = 15  # points of the model, each seen by three photos or more, that hold a place
PARTNERS = 2  # other photos that share some of them
SHARED = 6  # points that make a photo a partner
AGAINST = 0.5  # of the evidence on a photo's place, what may speak against it
MOVES = 0.02  # of its distance, by which a place may move when the other photos give its points
FIRM_POINTS = 100  # points that hold a place firmly, where it moves
FIRM_MOVES = 0.01  # by no more than this
FIRM_AGAINST = 0.75  # of the evidence, what may speak against a place that is held firmly
FEW_FEATURES = 150  # in a photo
COMMON = 5  # photos in two solutions that can be compared
FEW_SHARED = 15  # features that COLMAP needs for a pair


@dataclass(frozen=True)
class Support:
    """What holds the place of one photo.

    Args:
        points: of the model that it and two more photos see.
        partners: photos that share at least six points with it.
        against: verified matches with other placed photos that its place contradicts, as a share
            of these and of the points that it shares with the same photos.
        moves: how far its place moves when the others alone give its points, by its distance.
    """

    points: int
    partners: int
    against: float
    moves: float


def supports(poses: Poses) -> dict[str, Support]:
    """File name -> what holds its place, for every placed photo."""
    times = np.zeros(len(poses.points), np.int64)
    for track in poses.tracks.values():
        times[track] += 1
    evidence = poses.evidence
    found = {}
    for file in poses.cam_from_world:
        points = int((times[poses.tracks[file]] >= 3).sum())
        partners, against, moves = len(poses.cam_from_world) - 1, 0.0, 0.0
        if evidence is not None:
            partners, against = _partners_and_contradiction(evidence, file)
            moves = float(evidence.moves[evidence.names.index(file)])
        found[file] = Support(points, partners, against, moves)
    return found


def trusted(poses: Poses) -> list[str]:
    """The files whose places are trusted; those that features did not give are not questioned."""
    doubts = _doubts(poses)
    return [file for file in poses.cam_from_world if file not in doubts]


def standing(poses: Poses) -> tuple[int, int, int]:
    """How much was found: photos that are trusted, photos placed, points. More is better."""
    return len(trusted(poses)), len(poses.cam_from_world), len(poses.points)


def deviation(one: Poses, other: Poses) -> float | None:
    """How far two solutions put the photos apart that both place where they can be trusted.

    Median of the centres' distances after a similarity, by the median distance of the centres from
    their middle. Where these photos are fewer than five, all that both placed are compared. None
    if those are fewer too.
    """
    placed = set(one.cam_from_world) & set(other.cam_from_world)
    both = placed & set(trusted(one)) & set(trusted(other))
    files = sorted(both if len(both) >= COMMON else placed)
    if len(files) < COMMON:
        return None
    a, b = (
        np.stack([center_of(poses.cam_from_world[file]) for file in files])
        for poses in (other, one)
    )
    world = robust_similarity(a, b)
    misses = np.linalg.norm(a @ world[:3, :3].T + world[:3, 3] - b, axis=1)
    size = np.median(np.linalg.norm(b - np.median(b, axis=0), axis=1))
    return float(np.median(misses) / max(float(size), 1e-12))


def reasons(
    poses: Poses | None, evidence: Evidence | None, said: Mapping[str, str]
) -> dict[str, str]:
    """File name -> why it has no trusted place, in words, for each photo without one.

    Args:
        evidence: of the poses, or what is known where there are none.
        said: file name -> the photo's name for people.
    """
    doubts = {} if poses is None else _doubts(poses)
    placed = {} if poses is None else poses.cam_from_world
    out = {}
    for file in said:
        if file not in placed:
            out[file] = _why_unplaced(evidence, file, said)
        elif file in doubts:
            out[file] = doubts[file]
    return out


def _doubts(poses: Poses) -> dict[str, str]:
    """File name -> why its place is not trusted: by itself, or with the group it belongs to."""
    if poses.evidence is None:
        return {}
    least = min(PARTNERS, len(poses.cam_from_world) - 1)
    found = {f: _doubt(s, least) for f, s in supports(poses).items() if f not in poses.by_mat}
    doubts = {file: why for file, why in found.items() if why}
    left = [file for file, why in found.items() if not why]
    while cut := contradicted_group(poses.evidence, left):
        others = f" and {len(cut.files) - 1} others" if len(cut.files) > 1 else ""
        why = (
            f"{cut.against:.0%} of the matches between it{others} and the rest contradict the "
            "places"
        )
        doubts |= dict.fromkeys(cut.files, why)
        left = [file for file in left if file not in doubts]
    return doubts


def _doubt(support: Support, least: int) -> str:
    """Why a place is not trusted; empty if it is."""
    if support.points < POINTS:
        return f"only {support.points} points that two other photos see too hold its place"
    if support.partners < least:
        return f"shares points with {support.partners} other photo only"
    firm = support.points >= FIRM_POINTS and support.moves <= FIRM_MOVES
    if support.against > (FIRM_AGAINST if firm else AGAINST):
        return (
            f"{support.against:.0%} of what its matches with other photos say speaks against the "
            "place that was found for it"
        )
    if support.moves > MOVES:
        how = f"moves it by {support.moves:.0%} of its distance"
        if not np.isfinite(support.moves):
            how = "cannot be done"
        return f"its place is not certain: finding it again from what only the others see {how}"
    return ""


def _partners_and_contradiction(evidence: Evidence, file: str) -> tuple[int, float]:
    row = evidence.names.index(file)
    mine = (evidence.pairs == row).any(1)
    shared, inliers, agree = evidence.shared[mine], evidence.inliers[mine], evidence.agree[mine]
    against = float((inliers * (1 - np.nan_to_num(agree, nan=1.0))).sum())
    return int((shared >= SHARED).sum()), against / max(against + float(shared.sum()), 1.0)


def _why_unplaced(evidence: Evidence | None, file: str, said: Mapping[str, str]) -> str:
    if evidence is None or file not in evidence.names:
        return "shares too few features with the others"
    row = evidence.names.index(file)
    count = int(evidence.features[row])
    if count < FEW_FEATURES:
        return f"only {count} features were found in it: it is blurred, dark or too plain"
    best, partner = _best_partner(evidence, row)
    if best < FEW_SHARED:
        return (
            f"shares {best} features with its best partner {said.get(partner, partner)}, at least "
            f"{FEW_SHARED} are needed"
            if best
            else "shares no features with any other photo"
        )
    return (
        f"shares {best} features with its best partner {said.get(partner, partner)}, but they do "
        "not lead to one place among the other photos"
    )


def _best_partner(evidence: Evidence, row: int) -> tuple[int, str]:
    mine = np.flatnonzero((evidence.pairs == row).any(1))
    if not len(mine):
        return 0, ""
    best = mine[evidence.inliers[mine].argmax()]
    a, b = evidence.pairs[best]
    return int(evidence.inliers[best]), evidence.names[int(b if a == row else a)]


def conflict(evidence: Evidence, *, held: bool = False) -> float:
    """Share of the verified matches between placed photos that contradict the places.

    Where a place is right, matches may still contradict it: things that repeat, and what shiny
    surfaces mirror. So photos are judged by what speaks for their places too.

    Args:
        held: only of the pairs that the mapper did not get.
    """
    known = ~np.isnan(evidence.agree) & (evidence.held | (not held))
    weight = evidence.inliers[known].astype(float)
    return float(((1 - evidence.agree[known]) * weight).sum() / max(weight.sum(), 1.0))


def groups(evidence: Evidence, files: list[str], *, least: int) -> list[list[str]]:
    """The files in groups that hang together by pairs of at least so many shared points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    row = {name: i for i, name in enumerate(evidence.names)}
    strong = evidence.pairs[evidence.shared >= least]
    ones = np.ones(len(strong))
    graph = coo_array((ones, (strong[:, 0], strong[:, 1])), shape=(len(row), len(row)))
    labels: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    found: dict[int, list[str]] = {}
    for file in files:
        found.setdefault(int(labels[row[file]]), []).append(file)
    return sorted(found.values(), key=len, reverse=True)
