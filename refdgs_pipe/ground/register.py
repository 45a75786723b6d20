"""Poses refined by image registration: each photo against the texture of the ground plane.

Few features are matched on a plane that is seen at a grazing angle, so structure from motion can
put low photos several pixels off. The texture of the plane tells more: each photo is compared with
the plane as the other photos show it, and its pose is changed to fit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera, Lens
from refdgs_pipe.ground.adjust import Sight, State, adjusted, bending, misses
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.relief import Places, lifted, relief
from refdgs_pipe.ground.shots import F32, Bools, logs_of, mapped

U8 = NDArray[np.uint8]

SIDE = 800  # px that photos are reduced to
CELLS, REACH = 640, 2.5  # of the plane's picture along an edge; its reach in radii of the ball
ROUNDS = 3
FINE = 1 / 64  # of the photo's longer side: coarser differences of brightness do not count
STEEPEST = 120  # photos that make the picture
PLACES, APART = 800, 6  # of the picture that are looked for in a photo; px between them
QUALITY = 0.01  # of the strongest corner
WINDOW, LEVELS = 25, 3  # px, and halvings, of the search
BACK = 0.5  # px by which the search back to the picture may miss
PATCH, ALIKE = 17, 0.75  # px that are compared, and their least correlation
CONTRAST = 0.6  # of log brightness, that eight bits hold
LEAST = 30  # places that have to be found again
MISS = 0.6  # px, median, by which the places of a photo that fits may miss
MOST = 0.5  # share of the photos that have to fit
BETTER = 0.95  # of the cost, below which other lenses are believed


@dataclass(frozen=True)
class Registered:
    """A model whose photos were laid on the plane.

    Args:
        model: with the new poses and lenses.
        misses: name -> median distance of its places from where they should be, before and after,
            px of a photo of 800 px; of the photos that fit.
        unseen: names of photos in which the plane's texture was not found near its place.
    """

    model: SparseModel
    misses: dict[str, tuple[float, float]]
    unseen: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Frame:
    """A photo at a working size, through the lens that was found at first.

    Args:
        fine: (H, W) log brightness without what is coarse.
    """

    camera: Camera
    fine: F32
    valid: Bools
    held: F64
    lens: int


def registered(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    progress: Callable[[int, int], None],
    threads: int = 1,
) -> Registered | None:
    """Poses and lenses that fit the plane's texture, or None where photos do not agree on it.

    Photos that do not show the plane, or do not fit it, keep their poses.

    Args:
        plane: unit normal and offset, world.
        progress: told the steps done and their number; may raise.
        threads: photos that are worked on at a time; the result does not depend on it.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    groups = sorted({_key(model.lenses[name]) for name in model.names})
    progress(0, ROUNDS + 1)

    def frame(camera: Camera) -> Frame:
        return frame_of(views, model, camera, groups.index(_key(model.lenses[camera.name])))

    frames = mapped(frame, model.cameras, threads)
    ground = Ground.under(model.ball, *plane, REACH * model.ball.radius)
    poses = [camera.cam_from_world for camera in model.cameras]
    at_first = State(np.stack(poses), np.zeros((len(groups), 2)))
    state, sights = at_first, [sight_of(frame, None) for frame in frames]
    first: list[float] = []
    free_lenses = True
    for done in range(ROUNDS):
        progress(done + 1, ROUNDS + 1)
        sights = _sights(frames, state, ground, threads)
        first = first or _medians(sights, state)
        fixed, cost = adjusted(sights, state, free_lenses=False)
        free, less = adjusted(sights, state, free_lenses=True)
        free_lenses = free_lenses and less < BETTER * cost
        state = free if free_lenses else fixed
    progress(ROUNDS + 1, ROUNDS + 1)
    after = _medians(sights, state)
    fits = np.array(after) < MISS
    if fits.mean() < MOST:
        return None
    if not state.lenses.any():
        state = State(np.where(fits[:, None, None], state.poses, at_first.poses), state.lenses)
    names = model.names
    told = {n: (a, b) for n, a, b, fit in zip(names, first, after, fits, strict=True) if fit}
    lenses = {
        name: _changed(model.lenses[name], state.lenses[frame.lens])
        for name, frame in zip(names, frames, strict=True)
    }
    placed = model.placed(dict(zip(names, state.poses, strict=True)))
    cameras = tuple(
        replace(camera, K=_longer(camera.K, state.lenses[frame.lens]))
        for camera, frame in zip(placed.cameras, frames, strict=True)
    )
    laid = replace(placed, cameras=cameras, lenses=model.lenses | lenses)
    return Registered(laid, told, _unseen(names, after))


def _key(lens: Lens) -> tuple[float, ...]:
    return (*lens.K.ravel().tolist(), *lens.distortion.tolist())


def frame_of(views: Views, model: SparseModel, camera: Camera, lens: int) -> Frame:
    """The photo of a camera at a working size.

    Args:
        lens: index of its lens.

    Raises:
        CorruptError: the photo is missing or damaged.
    """
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    photo = load_photo(views, model, camera, scale=scale)
    grey = logs_of(photo.rgb).mean(-1)
    fine = grey - cv2.GaussianBlur(grey, (0, 0), FINE * max(grey.shape))
    track = model.tracks.get(camera.name, np.zeros(0, np.int64))
    return Frame(photo.camera, fine.astype(np.float32), photo.valid, model.points[track], lens)


def sight_of(frame: Frame, found: tuple[F64, F64] | None) -> Sight:
    """What is known of a frame, with places on the plane and where they were found."""
    points, pixels = (np.zeros((0, 3)), np.zeros((0, 2))) if found is None else found
    at, depth = frame.camera.project(frame.held)
    ahead = depth > 0
    return Sight(frame.camera.K, points, pixels, frame.held[ahead], at[ahead], frame.lens)


def _sights(frames: list[Frame], state: State, ground: Ground, threads: int) -> list[Sight]:
    """Look for the plane's picture in all photos."""
    cameras = [
        replace(f.camera, K=_longer(f.camera.K, state.lenses[f.lens]), cam_from_world=pose)
        for f, pose in zip(frames, state.poses, strict=True)
    ]
    images = [
        _seen_through(f, camera, state.lenses[f.lens])
        for f, camera in zip(frames, cameras, strict=True)
    ]
    picture = picture_of(images, cameras, ground, threads)

    def found(i: int) -> tuple[F64, F64] | None:
        return found_on(picture, images[i], cameras[i], ground)

    pairs = mapped(found, range(len(frames)), threads)
    radius = ground.radius / REACH
    places = [
        Places.of(ground, camera.center, pair[0], ground.points(camera, pair[1]), radius)
        for pair, camera in zip(pairs, cameras, strict=True)
        if pair is not None
    ]
    bumps = relief(places, REACH) if places else None

    def sight(i: int) -> Sight:
        frame, camera, pair = frames[i], cameras[i], pairs[i]
        if pair is None or bumps is None:
            return sight_of(frame, None)
        points, pixels = lifted(ground, pair[0], bumps, radius), pair[1]
        middle, lens = camera.K[:2, 2], state.lenses[frame.lens]
        x = (pixels - middle) / np.diag(camera.K)[:2]
        return sight_of(frame, (points, middle + bending(x, lens) * (pixels - middle)))

    return [sight(i) for i in range(len(frames))]


def _seen_through(frame: Frame, camera: Camera, lens: F64) -> F32:
    """(H, W) the photo as a camera without distortion shows it, NaN where it shows nothing."""
    image = np.where(frame.valid, frame.fine, np.float32(np.nan))
    if not lens.any():
        return image
    rays = camera.pixel_rays()[..., :2]
    focal = np.diag(camera.K)[:2]
    grid = (camera.K[:2, 2] + focal * bending(rays, lens) * rays - 0.5).astype(np.float32)
    out = cv2.remap(
        image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderValue=(float("nan"),) * 4
    )
    return np.asarray(out, np.float32)


def picture_of(images: list[F32], cameras: list[Camera], ground: Ground, threads: int) -> F32:
    """(n, n) the plane as half of the photos, those that see a place most steeply, show it."""
    normal = np.cross(ground.a, ground.b)
    away = np.stack([camera.center for camera in cameras]) - ground.origin
    steep = np.abs(away @ normal) / np.linalg.norm(away, axis=1)
    order = np.argsort(-steep, kind="stable")
    order = order[np.linspace(0, len(order) - 1, min(len(order), STEEPEST)).round().astype(int)]

    def flat(i: int) -> F32:
        return ground.flattened(images[i], cameras[i], CELLS)

    stack = np.stack(mapped(flat, [int(i) for i in order], threads))
    most = max(16, len(order) // 2)
    out = np.full(stack.shape[1:], np.nan, np.float32)
    for row in range(CELLS):
        values = stack[:, row]
        there = np.isfinite(values)
        values = np.where(there & (np.cumsum(there, 0) <= most), values, np.nan)
        enough = np.isfinite(values).sum(0) >= 3
        out[row, enough] = np.nanmedian(values[:, enough], 0)
    return out


def found_on(picture: F32, image: F32, camera: Camera, ground: Ground) -> tuple[F64, F64] | None:
    """Places (n, 3) on the plane, and the pixels (n, 2) where a photo shows them."""
    expected = ground.drawn(picture, camera)
    known = np.isfinite(expected).astype(np.uint8)
    inner = cv2.erode(known, np.ones((PATCH, PATCH), np.uint8))
    one, other = eight_bits(expected), eight_bits(image)
    corners = cv2.goodFeaturesToTrack(one, PLACES, QUALITY, APART, mask=inner)
    if corners is None:
        return None
    there, ok = _followed(one, other, corners)
    back, ok_back = _followed(other, one, there)
    start, there, back = corners[:, 0], there[:, 0], back[:, 0]
    good = (ok[:, 0] > 0) & (ok_back[:, 0] > 0)
    good &= np.linalg.norm(back - start, axis=1) < BACK
    if good.sum() < LEAST:
        return None
    good[good] = _correlation(one, other, start[good], there[good]) > ALIKE
    if good.sum() < LEAST:
        return None
    points = ground.points(camera, start[good].astype(np.float64) + 0.5)
    return points, there[good].astype(np.float64) + 0.5


def _followed(one: U8, other: U8, places: F32) -> tuple[F32, U8]:
    """Where places (n, 1, 2) of one picture are in another, and whether they were found."""
    window = (WINDOW, WINDOW)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(
        one,
        other,
        places,
        None,
        winSize=window,
        maxLevel=LEVELS,
    )
    return np.asarray(there, np.float32), np.asarray(ok, np.uint8)


def eight_bits(fine: F32) -> U8:
    """(H, W) log brightness without what is coarse, as a picture; 127 where nothing is known."""
    scaled = (np.nan_to_num(fine) / CONTRAST + 1) * 127.5
    return scaled.clip(0, 255).astype(np.uint8)


def _correlation(one: U8, other: U8, at: F32, there: F32) -> F64:
    """(n,) of the patches round places of two pictures."""
    step = np.arange(PATCH) - PATCH // 2
    dy, dx = (d.ravel().astype(np.float32) for d in np.meshgrid(step, step, indexing="ij"))

    def patches(image: U8, places: F32) -> F32:
        x, y = places[:, :1] + dx, places[:, 1:] + dy
        found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values = found.astype(np.float32)
        return np.asarray(values - values.mean(1, keepdims=True), np.float32)

    a, b = patches(one, at), patches(other, there)
    size = np.sqrt((a * a).sum(1) * (b * b).sum(1))
    return np.asarray((a * b).sum(1) / np.maximum(size, 1e-9), np.float64)


def _medians(sights: list[Sight], state: State) -> list[float]:
    """The median miss of each photo, px; infinite where nothing was found."""
    out = []
    for sight, pose in zip(sights, state.poses, strict=True):
        off = misses(sight, pose, state.lenses[sight.lens])
        out.append(float(np.median(off)) if len(off) else float("inf"))
    return out


def _unseen(names: list[str], misses: list[float]) -> frozenset[str]:
    """The photos in which nothing was found."""
    return frozenset(name for name, miss in zip(names, misses, strict=True) if np.isinf(miss))


def _longer(K: F64, lens: F64) -> F64:
    """Intrinsics with the focal length that was found."""
    out = K.copy()
    out[0, 0], out[1, 1] = (1 + lens[0]) * K[0, 0], (1 + lens[0]) * K[1, 1]
    return out


def _changed(lens: Lens, change: F64) -> Lens:
    """A lens after its focal length and radial distortion changed; to second order."""
    longer, k = 1 + change[0], lens.distortion.copy()
    k1 = k[0] * longer**2
    k[1] = k[1] * longer**4 + 3 * change[1] * k1
    k[0] = k1 + change[1]
    return Lens(_longer(lens.K, change), k)
