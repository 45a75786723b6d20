"""Whether a placement can be trusted as a whole: evidence, not counts.

Photos are dropped one by one where their own evidence is weak (trust.py), where they hang together
with the others by few points, or where they do not look at the object. What is left has to pass a
list of checks; each says what was found and what to do about it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from refdgs_pipe.artifacts.placement import Evidence, Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.errors import PoseError
from refdgs_pipe.sfm.alike import AS_FAR, Agreement, agreement, times_as_far, turned_deg
from refdgs_pipe.sfm.gaps import gaps_of
from refdgs_pipe.sfm.posed import model_from_poses
from refdgs_pipe.sfm.trust import conflict, groups, reasons

BRIDGE = 10  # points that have to hold two groups of photos together
FARTHER = 5.0  # times the median distance, or as many times nearer: not of the same capture
ASIDE = 1.25  # of the angle from the axis to the photo's corner, beyond which the object lies
CONFLICT = 0.6  # of the matches between placed photos that may contradict the places
HELD_CONFLICT = 0.75  # in the pairs that the mapper did not get; they are few
HELD_PAIRS = 5
CLOSE_DEG = 10.0  # between two photos that should look nearly alike, seen from what they show
CLOSE_PAIRS = 5
CLOSE_SHARE = 0.09  # of the features in the one with fewer, that such photos share
APART = 0.1  # of the photos' distance from their middle, between two solutions
BALL_POINTS = 30  # points in the object ball, each seen by three photos
BALL_PHOTOS = 0.5  # of the photos that have to see some of them
BALL_SEEN = 5  # points that count as some
SPREAD_DEG = 10.0  # between the directions that the object is seen from
PARALLAX_DEG = 1.5  # median angle at which neighbouring photos see the points in the ball
NAMES_SHOWN = 8
LIKE_PAIRS = 2  # of close photos
LIKE_SHARE = 0.46  # of the points without a match, that look alike in them
NEAR_PAIRS = 4
UNEVEN = 0.085  # difference of the logarithms of light
OTHER_LIGHT = 0.08  # of the points that look alike, that may be lit otherwise
_REPEATS = (
    "The ground seems to repeat (checks, tiles or dots), and what tells its repeats apart is too "
    "weak. Put the object on the printed mat, on newspaper or on another ground whose pattern does "
    "not repeat, keep much of it in the picture, and take the photos again"
)
_FEW = (
    "Take more photos between those without a place and the others, each sharing two thirds of its "
    "picture with the next, sharp and evenly lit, with a textured ground (newspaper, the printed "
    "mat) in sight"
)
_EQUAL_SIDES = (
    "Photos of different sides seem to lie in one place: the object or its surroundings repeat. "
    "Put something that is not repeated on the ground beside the object, and take more photos in "
    "between"
)


@dataclass(frozen=True)
class Check:
    """One thing that has to hold.

    Args:
        name: what is checked, in words; found: what was found.
        advice: what to do where it does not hold.
    """

    name: str
    found: str
    is_met: bool
    advice: str


@dataclass(frozen=True)
class Judgement:
    """What became of a placement.

    Args:
        model: the photos that can be trusted; None where there is nothing to build on.
        lost: name of a view -> why it has no trusted place.
        checks: in the order of their weight.
        gaps: sentences that name the photos on both sides of a gap.
    """

    model: SparseModel | None
    lost: dict[str, str]
    checks: tuple[Check, ...]
    gaps: tuple[str, ...]

    @property
    def is_trusted(self) -> bool:
        return self.model is not None and all(check.is_met for check in self.checks)

    @property
    def may_be_trusted(self) -> bool:
        """Whether at most the number of photos with a place is too small."""
        return self.model is not None and all(check.is_met for check in self.checks[1:])


def examine(views: Views, placement: Placement, *, least: float) -> Judgement:
    """Judge a placement by its evidence. Photos that were placed close together are read.

    Args:
        least: share of the photos that must have a trusted place.
    """
    said = _files(views)
    poses = placement.poses
    evidence = None if poses is None else poses.evidence
    lost = reasons(poses, evidence, said)
    if poses is not None and evidence is not None:
        left = [f for f in poses.cam_from_world if f not in lost and f not in poses.by_mat]
        for apart in groups(evidence, left, least=BRIDGE)[1:]:
            why = f"fewer than {BRIDGE} points hold it and {len(apart) - 1} others to the rest"
            lost |= dict.fromkeys(apart, why)
    model = _model(views, placement, lost)
    if model is not None:
        stray = _strays(model)
        if stray and len(stray) < len(model.cameras):
            lost |= {f"{name}.png": why for name, why in stray.items()}
            model = _model(views, placement, lost)
    checks = [_enough(len(said), len(lost), least, repeats=placement.repeats)]
    gaps: tuple[str, ...] = ()
    if model is not None and poses is not None:
        if evidence is not None:
            checks.append(_agreeing(conflict(evidence)))
            checks += [*_held_out(evidence), *_alike(model, evidence)]
        if poses.rival is not None:
            checks.append(_two_solutions(poses.rival))
        if evidence is not None:
            checks += _looking_alike(agreement(model, views))
            checks += _about_the_ball(model)
        checks.append(_spread(model))
        gaps = gaps_of(model, _said(views))
    names = {file: file.removesuffix(".png") for file in said}
    return Judgement(model, {names[f]: why for f, why in lost.items()}, tuple(checks), gaps)


def with_places(
    judgement: Judgement, views: Views, placement: Placement, model: SparseModel, *, least: float
) -> Judgement:
    """The judgement after photos that were lost found a place in a model.

    Args:
        least: as in `examine`.
    """
    lost = {one.name: one.reason for one in model.lost}
    enough = _enough(len(views.items), len(lost), least, repeats=placement.repeats)
    gaps = gaps_of(model, _said(views))
    return Judgement(model, lost, (enough, *judgement.checks[1:]), gaps)


def check_trusted(views: Views, judgement: Judgement, *, attempts: int) -> SparseModel:
    """The model of a trusted placement.

    Raises:
        PoseError: it cannot be trusted; says why, names photos and what to do.
    """
    if judgement.is_trusted and judgement.model is not None:
        return judgement.model
    failed = [check for check in judgement.checks if not check.is_met]
    total, count = len(views.items), len(views.items) - len(judgement.lost)
    said = _said(views)
    parts = [f"only {count} of {total} photos found a place that can be trusted"]
    if count == total:
        parts = [f"all {total} photos found a place, but the places cannot be trusted"]
    parts[0] += f" ({attempts} ways of placing them were tried)"
    parts += [f"{check.name}: {check.found}. {check.advice}" for check in failed]
    parts += [f"{said[name]}: {why}" for name, why in list(judgement.lost.items())[:NAMES_SHOWN]]
    if len(judgement.lost) > NAMES_SHOWN:
        parts.append(f"and {len(judgement.lost) - NAMES_SHOWN} more without a place")
    parts += judgement.gaps[:3]
    parts.append(
        "the report shows what was found. If you know better, lower gate.min_trusted or give the "
        "poses with the photos (transforms.json, sparse/0)"
    )
    raise PoseError("\n  ".join(parts))


def _said(views: Views) -> dict[str, str]:
    """Name of a view -> the photo's name for people."""
    return {view.name: view.source or view.name for view in views.items}


def _files(views: Views) -> dict[str, str]:
    """File name, as structure from motion has it -> the photo's name for people."""
    return {f"{view.name}.png": view.source or view.name for view in views.items}


def _model(views: Views, placement: Placement, lost: Mapping[str, str]) -> SparseModel | None:
    """The model of the photos that are left; None if they are too few or look at nothing."""
    poses = placement.poses
    if poses is None or sum(file not in lost for file in poses.cam_from_world) < 3:
        return None
    try:
        model = model_from_poses(views, poses, lost, up=placement.up)
    except PoseError:
        return None
    if placement.metres_per_unit is None:
        return model
    scale = float(np.cbrt(np.linalg.det(model.sfm_from_world[:3, :3])))
    return replace(model, metres_per_unit=placement.metres_per_unit * scale)


def _strays(model: SparseModel) -> dict[str, str]:
    """Cameras that stand at another scale, or do not look at the object."""
    away = {c.name: float(np.linalg.norm(c.center - model.ball.center)) for c in model.cameras}
    middle = float(np.median(list(away.values())))
    found = {}
    for camera in model.cameras:
        times = away[camera.name] / max(middle, 1e-12)
        if not 1 / FARTHER < times < FARTHER:
            word = "farther away than" if times > 1 else "nearer than"
            factor = max(times, 1 / max(times, 1e-12))
            found[camera.name] = f"its place is {factor:.0f} times {word} the others'"
        elif not _looks_at(camera, model.ball.center, model.ball.radius):
            found[camera.name] = "from the place found for it, the object is not in the picture"
    return found


def _looks_at(camera: Camera, center: F64, radius: float) -> bool:
    x = camera.cam_from_world[:3, :3] @ center + camera.cam_from_world[:3, 3]
    distance = float(np.linalg.norm(x))
    if distance <= radius:
        return True
    angle = np.arccos(np.clip(x[2] / distance, -1, 1)) - np.arcsin(radius / distance)
    corner = np.array([camera.width / 2 / camera.K[0, 0], camera.height / 2 / camera.K[1, 1]])
    return bool(angle < ASIDE * np.arctan(np.linalg.norm(corner)))


def _enough(total: int, lost: int, least: float, *, repeats: bool) -> Check:
    count = total - lost
    return Check(
        "photos with a trusted place",
        f"{count} of {total}, {least:.0%} are needed",
        count >= max(3, least * total),
        _REPEATS if repeats else _FEW,
    )


def _agreeing(share: float) -> Check:
    return Check(
        "matches that contradict the places",
        f"{share:.0%}, at most {CONFLICT:.0%} are usual",
        share <= CONFLICT,
        "Something repeats or moves: equal things side by side, a background that moves with the "
        "object, photos of two captures in one folder. Cover or mask it, or take it away",
    )


def _held_out(evidence: Evidence) -> list[Check]:
    """The pairs that the mapper did not get, where there are enough."""
    count = int((evidence.held & ~np.isnan(evidence.agree)).sum())
    if count < HELD_PAIRS:
        return []
    share = conflict(evidence, held=True)
    found = (
        f"{share:.0%} in {count} pairs that were kept for this, at most {HELD_CONFLICT:.0%} are "
        "usual"
    )
    advice = _agreeing(share).advice
    return [Check("contradicting matches in pairs held out", found, share <= HELD_CONFLICT, advice)]


def _alike(model: SparseModel, evidence: Evidence) -> list[Check]:
    """Whether photos that were placed close together share features, as neighbours do.

    Where an object has equal sides, photos of different sides can get the same place. All their
    matches agree, but what differs between the sides has no match (missing correspondences: Zach,
    Irschara and Bischof 2008).

    Args:
        model: the photos that are trusted; pairs of others do not count, and pairs of a close-up
            and a photo from afar, which shows more, and coarser. Nor do photos of different sides
            that share a far wall, whose rays to it are nearly parallel.
    """
    a, b = evidence.pairs.T
    cameras = {f"{camera.name}.png": camera for camera in model.cameras}
    names = evidence.names
    kept = np.array([name in cameras for name in names])
    close = (evidence.angle < CLOSE_DEG) & (evidence.shared >= BRIDGE)
    close &= kept[a] & kept[b] & ~np.isnan(evidence.agree)
    close[close] = [
        _as_near(model, cameras[names[i]], cameras[names[j]])
        for i, j in zip(a[close], b[close], strict=True)
    ]
    if close.sum() < CLOSE_PAIRS:
        return []
    moving = evidence.features * (1 - evidence.still)
    fewer = np.maximum(np.minimum(moving[a], moving[b]), 1.0)[close]
    share = float(np.median((evidence.inliers * evidence.agree)[close] / fewer))
    return [
        Check(
            "features shared by photos with nearly the same place",
            f"{share:.0%} in {int(close.sum())} pairs, {CLOSE_SHARE:.0%} are needed",
            share >= CLOSE_SHARE,
            _EQUAL_SIDES,
        )
    ]


def _as_near(model: SparseModel, one: Camera, other: Camera) -> bool:
    """Whether both show the object from one side, about as far from the points that both see."""
    if turned_deg(one, other, model.ball.center) >= CLOSE_DEG:
        return False
    shared = np.intersect1d(model.tracks[one.name], model.tracks[other.name])
    if not len(shared):
        return False
    return 1 / AS_FAR < times_as_far(one, other, model.points[shared]) < AS_FAR


def _looking_alike(found: Agreement) -> list[Check]:
    """Whether photos that were placed close together show the same, and lit alike."""
    checks = []
    if found.pairs >= LIKE_PAIRS:
        share = f"{found.share:.0%} in {found.pairs} pairs, {LIKE_SHARE:.0%} are needed"
        name = "points that look alike in photos with nearly the same place"
        checks.append(Check(name, share, found.share >= LIKE_SHARE, _EQUAL_SIDES))
    if found.near >= NEAR_PAIRS:
        apart = f"{found.uneven:.0%} in {found.near} pairs, at most {UNEVEN:.0%} are usual"
        name = "difference in light between photos with the same place"
        checks.append(Check(name, apart, found.uneven <= UNEVEN, _EQUAL_SIDES))
    if found.told >= NEAR_PAIRS:
        lit = f"{found.other_light:.0%} in {found.told} pairs"
        lit += f", at most {OTHER_LIGHT:.0%} are usual"
        name = "points that look alike but are lit otherwise, in photos with the same place"
        checks.append(Check(name, lit, found.other_light <= OTHER_LIGHT, _EQUAL_SIDES))
    return checks


def _two_solutions(apart: float) -> Check:
    return Check(
        "distance between two solutions from the same matches",
        f"{apart:.0%} of the photos' distances, at most {APART:.0%} are usual",
        apart <= APART,
        "The photos fit together in more than one way. Take more photos in between, and put more "
        "texture round the object",
    )


def _about_the_ball(model: SparseModel) -> list[Check]:
    """Whether points lie on and near the object, and whether photos see them from apart."""
    inside = np.linalg.norm(model.points - model.ball.center, axis=1) < model.ball.radius
    times = np.zeros(len(model.points), np.int64)
    for track in model.tracks.values():
        times[track] += 1
    good = inside & (times >= 3)
    see = [int(good[model.tracks[camera.name]].sum()) for camera in model.cameras]
    share = float(np.mean([count >= BALL_SEEN for count in see]))
    parallax = _parallax(model, good)
    advice = (
        "Nothing with texture lies where the cameras look. Put the object on a textured ground or "
        "the printed mat, keep both in the picture, and let the light stand still"
    )
    return [
        Check(
            "points on and near the object",
            f"{int(good.sum())}, at least {BALL_POINTS} are needed",
            int(good.sum()) >= BALL_POINTS,
            advice,
        ),
        Check(
            "photos that see points on or near the object",
            f"{share:.0%}, {BALL_PHOTOS:.0%} are needed",
            share >= BALL_PHOTOS,
            advice,
        ),
        Check(
            "angle between the photos' views of these points",
            f"{parallax:.1f} degrees in the median, {PARALLAX_DEG:g} are needed",
            parallax >= PARALLAX_DEG,
            "The camera hardly moved against the object. Walk around it, or turn the object and "
            "keep the background plain",
        ),
    ]


def _parallax(model: SparseModel, good: np.ndarray) -> float:
    """Median over points of the widest angle between two of the rays to it, degrees."""
    rays: dict[int, list[F64]] = {}
    for camera in model.cameras:
        for point in model.tracks[camera.name][good[model.tracks[camera.name]]]:
            line = model.points[point] - camera.center
            rays.setdefault(int(point), []).append(line / np.linalg.norm(line))
    chosen = list(rays.values())[:: max(1, len(rays) // 2000)]
    widest = [float((np.stack(lines) @ np.stack(lines).T).min()) for lines in chosen]
    return float(np.degrees(np.median(np.arccos(np.clip(widest, -1, 1))))) if widest else 0.0


def _spread(model: SparseModel) -> Check:
    away = np.stack([camera.center - model.ball.center for camera in model.cameras])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    widest = float(np.degrees(np.arccos(np.clip((away @ away.T).min(), -1, 1))))
    return Check(
        "directions that the object was photographed from",
        f"{widest:.0f} degrees apart at most, {SPREAD_DEG:g} are needed",
        widest >= SPREAD_DEG,
        "All photos were taken from nearly the same place. Walk around the object",
    )
