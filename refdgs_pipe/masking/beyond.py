"""Where a photo shows the room: what its neighbours see there, far behind the object.

For pixels beside the plane the depth of the background is not known. Among depths behind the
object there is one at which other photos show the same, if the pixel is background (plane sweep,
Collins 1996); where they show nothing like it at any, the pixel is something else.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label
from scipy.ndimage import mean as mean_of

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64
from refdgs_pipe.geometry import homography_warp, through_plane
from refdgs_pipe.ground.shots import F32, Bools, Shot, box_around, grown, mapped
from refdgs_pipe.masking.table import LIMIT, SPREAD, TEXTURE, Evidence, alike, contrast, smooth

NEIGHBOURS = 5
LEAST_DEG, MOST_DEG = 7.0, 50.0  # between the directions to neighbours
DEPTHS = 28
MARGIN = 0.5  # of what is covered, that is judged round it
BEHIND = 1.3  # radii of the ball behind its centre, where the background begins
STRANGE, MOST_STRANGE = 0.5, 0.4  # evidence, and the share of the surroundings
EVEN = 0.6  # likeness that speaks for neither
TEXTURE_PATCH = 1.3  # pixels (sigma) over which texture is measured
TEXTURED = 0.5  # share of the usual texture beside the object at which likeness counts in full
LEAST = 0.5  # weight of likeness without any texture
PLAIN = 0.03  # contrast of log brightness below which a place has no texture
PLAIN_ROOM, PLAIN_SHARE = 0.012, 0.75  # contrast below which that share of a plain room lies
ONE_COLOUR = 0.02  # log colour: by how much the room differs on both sides of something thin
NEARLY = 2 * SPREAD  # log colour: what differs from a plain room by more is not like it by chance
OUTLINE = 1  # pixels round a plain room, in which its edge has texture
EDGES = 4  # pixels of the edge that separates a place, which show neither
AROUND = 0.125  # of the judged part's longer side, over which the room's plain colour is averaged


@dataclass(frozen=True)
class Room(Evidence):
    """Evidence beside the plane.

    Args:
        apart: (H, W) what looks like a plain room, but is not, as `_set_apart` finds it.
    """

    apart: Bools


@dataclass(frozen=True)
class _Neighbour:
    """What a photo is compared with: colours in logarithms, and where no object can hide them."""

    shot: Shot
    logs: F32
    free: F32


def shown_room(shots: list[Shot], ball: Ball, cover: list[Bools], threads: int = 1) -> list[Room]:
    """The evidence of whole photos near the object.

    Args:
        cover: (H, W) where each photo may show the object.
    """
    centers = np.stack([shot.camera.center for shot in shots]) - ball.center
    units = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(units @ units.T, -1, 1)))
    all_photos = [
        _Neighbour(shot, shot.logs, (shot.valid & ~hidden).astype(np.float32))
        for shot, hidden in zip(shots, cover, strict=True)
    ]

    def judge(i: int) -> Room:
        shot = shots[i]
        value = np.zeros(shot.valid.shape, np.float32)
        known, apart = np.zeros((2, *shot.valid.shape), bool)
        box = box_around(cover[i], MARGIN)
        order = np.argsort(np.where(angles[i] > LEAST_DEG, angles[i], 999))[:NEIGHBOURS]
        near = [all_photos[j] for j in order if LEAST_DEG < angles[i, j] < MOST_DEG]
        if box is not None and len(near) >= 2:
            first = float(np.linalg.norm(centers[i])) + BEHIND * ball.radius
            left, right, top, bottom = box
            part = (slice(top, bottom), slice(left, right))
            logs, free = shot.logs[part], all_photos[i].free[part] > 0
            apart[part] = _set_apart(np.ascontiguousarray(logs), free)
            value[part], known[part] = _judged(all_photos[i], near, box, 1 / first)
        return Room(np.where(apart, np.minimum(value, 0), value), known, apart)

    out = mapped(judge, range(len(shots)), threads)
    if _moves(out, cover):  # a turntable: the room turns about what is fixed in the poses
        unknown = [np.zeros_like(e.known) for e in out]
        return [Room(0 * e.value, no, no) for e, no in zip(out, unknown, strict=True)]
    return out


def is_plain(shots: list[Shot], beside: list[Bools]) -> bool:
    """Whether most photos show a room with hardly any texture.

    Args:
        beside: (H, W) where each photo shows the room, clear of the object.
    """
    textures = [
        np.quantile(contrast(shot.logs.mean(-1), TEXTURE_PATCH)[where], PLAIN_SHARE)
        for shot, where in zip(shots, beside, strict=True)
        if where.any()
    ]
    return bool(textures) and float(np.median(textures)) < PLAIN_ROOM


def _moves(evidence: list[Room], cover: list[Bools]) -> bool:
    """Whether even what shows no object is mostly like nothing that other photos see."""
    beside = [e.value[e.known & ~c] for e, c in zip(evidence, cover, strict=True)]
    values = np.concatenate(beside)
    return bool(len(values)) and float((values < -STRANGE).mean()) > MOST_STRANGE


def _judged(
    photo: _Neighbour, near: list[_Neighbour], box: tuple[int, ...], most: float
) -> tuple[F32, Bools]:
    """Evidence and whether it is known (h, w), for a box of a photo."""
    left, right, top, bottom = box
    width, height = right - left, bottom - top
    logs = np.ascontiguousarray(photo.logs[top:bottom, left:right])
    best = np.full((height, width), -1.0, np.float32)
    told = np.zeros((height, width), np.float32)
    for inverse in np.linspace(0, most, DEPTHS):
        likes = []
        for one in near:
            H = through_plane(photo.shot.camera, one.shot.camera, float(inverse))
            H = H @ _shift(left, top)
            other = homography_warp(one.logs, H, width, height, 9.0)
            clear = homography_warp(one.free, H, width, height, 0.0)
            seen = ((clear > 0.99) & (other[..., 0] < 8)).astype(np.float32)
            like = smooth(alike(logs, other) * seen, 1.3) / (smooth(seen, 1.3) + 1e-3)
            likes.append(np.where(seen > 0, like, -1))
        ranked = np.sort(np.stack(likes), 0)[-2:]
        two = ranked[0] >= 0
        best = np.where(two, np.maximum(best, ranked.mean(0)), best)
        told += two / np.float32(DEPTHS)
    known = best >= 0
    missed = 0.9 * np.clip(1.5 * told - 0.5, 0, 1)  # no depth matches, if most could be tried
    proof = _proof(logs, known & (photo.free[top:bottom, left:right] > 0))
    value = 3.5 * (best - EVEN) * np.where(best > EVEN, 1.2 * proof, missed)
    return np.where(known, value, 0).clip(-LIMIT, LIMIT).astype(np.float32), known


def _proof(logs: F32, beside: Bools) -> F32:
    """(H, W) from `LEAST` to 1: the weight of likeness, by the texture of the photo.

    In surroundings with texture, a pixel without any is like another photo at some depth by chance.

    Args:
        logs: (H, W, 3) the photo, log colour; beside: (H, W) its pixels beside the object.
    """
    texture = contrast(logs.mean(-1), TEXTURE_PATCH)
    usual = min(float(np.median(texture[beside])), TEXTURE) if beside.any() else 0.0
    return np.asarray(np.clip(texture / max(TEXTURED * usual, 1e-4), LEAST, 1), np.float32)


def _set_apart(logs: F32, free: Bools) -> Bools:
    """(H, W) what looks like a plain room at some depth, but is not.

    A mirror shows a plain room with nearly the room's colour, and edges separate it from the room.
    A hole shows the colour of the room beside it. Where the room varies by as much, the colour does
    not tell. What has texture is no part of a room of one colour.

    Args:
        logs: (H, W, 3) the photo, log colour; free: (H, W) its pixels beside the object.
    """
    plain = contrast(logs.mean(-1), TEXTURE_PATCH) < PLAIN
    parts, count = label(plain)
    joined = plain & np.isin(parts, np.unique(parts[plain & free]))
    if not count or not joined.any():
        return np.zeros_like(plain)
    sigma = AROUND * max(plain.shape)
    weight = np.maximum(smooth(joined.astype(np.float32), sigma), 1e-6)[..., None]
    room = smooth(logs * joined[..., None], sigma) / weight
    off = (logs - room).astype(np.float32)
    spread = (smooth(off**2 * joined[..., None], sigma) / weight).astype(np.float32)

    def of_parts(values: F32) -> F32:
        """(H, W) the largest channel's mean (H, W, 3) over each part; 0 between them."""
        means = [
            mean_of(channel, parts, range(1, count + 1)) for channel in np.moveaxis(values, -1, 0)
        ]
        return np.asarray(np.append(0, np.abs(means).max(0))[parts], np.float32)

    apart = of_parts(off)
    same = apart <= np.maximum(ONE_COLOUR, np.sqrt(of_parts(spread)))
    mirrors = plain & ~joined & ~same & (apart < NEARLY)
    one_colour = np.sqrt(spread.max(-1)) < ONE_COLOUR
    textured = ~plain & one_colour & ~grown(joined | (plain & same), OUTLINE)
    return np.asarray((grown(mirrors, EDGES) & ~plain) | mirrors | textured, np.bool_)


def _shift(left: float, top: float) -> F64:
    return np.array([[1, 0, left], [0, 1, top], [0, 0, 1.0]])
