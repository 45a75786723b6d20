"""Photos placed by the texture of the ground alone, where structure from motion failed.

Low photos show little of a scene to match: the ground at a grazing angle, and walls that repeat.
But the other photos show the ground whole. Drawn as a camera at a supposed place would see it, its
picture has the foreshortening of the photo, and features match (view synthesis: Mishkin, Matas and
Perdoch 2015). A place counts only if the photo then fits the picture as closely as the others do.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera, center_of, look_at
from refdgs_pipe.ground.adjust import State, adjusted, misses
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.register import (
    PATCH,
    REACH,
    Frame,
    eight_bits,
    found_on,
    frame_of,
    picture_of,
    sight_of,
)
from refdgs_pipe.ground.shots import F32, mapped
from refdgs_pipe.vectors import root_sift

AZIMUTHS, LEVELS = 24, (0.1, 0.5, 0.9)  # supposed places round the object; of the others' heights
FEATURES = 3000
CONTRAST, RATIO = 0.01, 0.85  # of features; of the best to the second best match
NEAR_PX, TRIES = 5.0, 2000  # of a match from where a place puts it; of the search for one
AGREE = 12  # matches that have to agree on a place
FEWEST = 60  # places of the picture that have to be found in the photo
MISS = 1.2  # px, median, by which they may miss
STEPS = 4
PERIOD, REPEATS = 0.04, 0.6  # of the picture's width, and likeness: it repeats at such a shift


@dataclass(frozen=True)
class _Guess:
    """The picture as a supposed camera would see it.

    Args:
        places: (n, 3) of its features on the ground; looks: (n, 128).
    """

    camera: Camera
    places: F64
    looks: F32


def placed_anew(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    apart: Mapping[str, Camera],
    progress: Callable[[int, int], None],
    threads: int = 1,
) -> dict[str, F64]:
    """Places of photos that found none, or a wrong one.

    Args:
        model: the other photos, which fit the ground; and the lenses of all.
        plane: unit normal and offset, world.
        apart: name -> camera of a photo, at the place that it was given, if any.
        progress: told the photos done and their number; may raise.

    Returns:
        Name -> (4, 4) cam_from_world, of the photos that fit; empty on a ground that repeats.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    right = [camera for camera in model.cameras if camera.name not in apart]
    frames = mapped(lambda camera: frame_of(views, model, camera, 0), right, threads)
    ground = Ground.under(model.ball, *plane, REACH * model.ball.radius)
    cameras = [frame.camera for frame in frames]
    images = [np.where(f.valid, f.fine, np.float32(np.nan)) for f in frames]
    picture = picture_of(images, cameras, ground, threads)
    if likeness(picture) > REPEATS:
        return {}
    del frames, images
    guesses: dict[tuple[float, ...], list[_Guess]] = {}
    out = {}
    for done, (name, camera) in enumerate(apart.items()):
        progress(done, len(apart))
        frame = frame_of(views, model, camera, 0)
        key = (*frame.camera.K.ravel().tolist(), frame.camera.width, frame.camera.height)
        if key not in guesses:
            supposed = _supposed(frame.camera, cameras, model.ball.center, plane[0])
            guesses[key] = mapped(lambda one: _guess(one, picture, ground), supposed, threads)
        own = [_guess(frame.camera, picture, ground)] if name in model.names else []
        pose = _placed(frame, picture, ground, own + guesses[key])
        if pose is not None:
            out[name] = pose
    progress(len(apart), len(apart))
    return out


def _supposed(camera: Camera, others: list[Camera], center: F64, up: F64) -> list[Camera]:
    """Cameras all round the object, as high and as far away as the others are."""
    away = np.stack([other.center for other in others]) - center
    distance = np.linalg.norm(away, axis=1)
    elevations = np.arcsin(np.clip(away @ up / distance, -1, 1))
    a = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    a /= np.linalg.norm(a)
    b = np.cross(up, a)
    out = []
    for level in LEVELS:
        e = float(np.quantile(elevations, level))
        for azimuth in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
            side = np.cos(azimuth) * a + np.sin(azimuth) * b
            eye = center + float(np.median(distance)) * (np.cos(e) * side + np.sin(e) * up)
            out.append(replace(camera, cam_from_world=look_at(eye, center, up)))
    return out


def _guess(camera: Camera, picture: F32, ground: Ground) -> _Guess:
    """The picture (n, n) of the ground, and its features, as a camera would see them."""
    expected = ground.drawn(picture, camera)
    known = np.isfinite(expected).astype(np.uint8)
    inner = cv2.erode(known, np.ones((PATCH, PATCH), np.uint8))
    pixels, looks = _features(eight_bits(expected), inner)
    return _Guess(camera, ground.points(camera, pixels), looks)


def _features(image: np.ndarray, mask: np.ndarray | None) -> tuple[F64, F32]:
    """Pixels (n, 2) and looks (n, 128) of features."""
    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=CONTRAST)
    keys, looks = sift.detectAndCompute(image, mask)
    if looks is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([key.pt for key in keys]) + 0.5, root_sift(looks)


def _placed(frame: Frame, picture: F32, ground: Ground, guesses: list[_Guess]) -> F64 | None:
    """The place at which the photo fits the picture; None if it fits at none."""
    image = np.where(frame.valid, frame.fine, np.float32(np.nan))
    pixels, looks = _features(eight_bits(image), frame.valid.astype(np.uint8))
    for guess in guesses:
        pose = _agreed(guess, pixels, looks)
        if pose is None or ground.height(center_of(pose)) <= 0:  # a mirrored photo fits from below
            continue
        pose = _refined(frame, image, picture, ground, pose)
        if pose is not None:
            return pose
    return None


def _agreed(guess: _Guess, pixels: F64, looks: F32) -> F64 | None:
    """A pose on which matches with a supposed view agree."""
    if min(len(looks), len(guess.looks)) < AGREE:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(guess.looks, looks, k=2)
    good = [one for one, two in pairs if one.distance < RATIO * two.distance]
    if len(good) < AGREE:
        return None
    rows, columns = [m.queryIdx for m in good], [m.trainIdx for m in good]
    points, seen = guess.places[rows], pixels[columns]
    shown, _ = guess.camera.project(points)
    _, inlier = cv2.findHomography(shown, seen, cv2.RANSAC, NEAR_PX, maxIters=TRIES)
    if inlier is None or inlier.sum() < AGREE:
        return None
    kept = inlier[:, 0] > 0
    start = guess.camera.cam_from_world
    turn, shift = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    ok, turn, shift = cv2.solvePnP(
        points[kept], seen[kept], guess.camera.K, None, turn, shift, useExtrinsicGuess=True
    )
    if not ok:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return pose if np.isfinite(pose).all() else None


def _refined(frame: Frame, image: F32, picture: F32, ground: Ground, pose: F64) -> F64 | None:
    """The pose after the photo was laid on the picture; None if it does not fit."""
    state = State(pose[None], np.zeros((1, 2)))
    bare = replace(frame, held=np.zeros((0, 3)), lens=0)
    sight = None
    for _ in range(STEPS):
        camera = replace(frame.camera, cam_from_world=state.poses[0])
        pair = found_on(picture, image, camera, ground)
        if pair is None:
            return None
        sight = sight_of(bare, pair)
        state, _ = adjusted([sight], state, free_lenses=False)
    assert sight is not None
    off = misses(sight, state.poses[0], state.lenses[0])
    fits = len(off) >= FEWEST and float(np.median(off)) < MISS
    return state.poses[0] if fits else None


def likeness(picture: F32) -> float:
    """The largest correlation of a picture (n, n) with itself, moved by `PERIOD` or farther.

    NaN is unknown; moves that leave less than a fifth of the picture to compare do not count.
    """
    known = np.isfinite(picture)
    n = len(picture)
    values = np.where(known, picture, 0.0)
    spectrum = np.fft.rfft2(values, (2 * n, 2 * n))
    there = np.fft.rfft2(known.astype(np.float64), (2 * n, 2 * n))
    both = np.fft.irfft2(np.abs(there) ** 2)
    squares = np.fft.rfft2(values**2, (2 * n, 2 * n))
    one = np.fft.irfft2(squares * np.conj(there))
    two = np.fft.irfft2(there * np.conj(squares))
    found = np.fft.irfft2(np.abs(spectrum) ** 2) / np.sqrt(np.maximum(one * two, 1e-9))
    y = np.fft.fftfreq(2 * n) * 2
    far = np.hypot(y[:, None], y[None, :]) > PERIOD
    return float(found[far & (both > 0.2 * known.sum())].max(initial=0.0))
