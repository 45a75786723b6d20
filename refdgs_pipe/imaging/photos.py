"""From the user's files to views: decoded, upright, masked, at most so large, in one folder."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from refdgs_pipe.artifacts.capture import Frame, MaskKind
from refdgs_pipe.artifacts.views import Exif, KnownPose, Skipped, View
from refdgs_pipe.camera import Lens
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import Pixels, orient, read_header, read_photo, write_png
from refdgs_pipe.files.kinds import PHOTO_SUFFIX, RAW_SUFFIX, VIDEO_SUFFIX, sniff
from refdgs_pipe.formatting import printable
from refdgs_pipe.imaging.masks import (
    U8,
    are_inverted,
    check_mask,
    read_alpha,
    read_depth_mask,
    read_mask,
    without_matte,
)
from refdgs_pipe.imaging.metadata import held_against, read_exif
from refdgs_pipe.imaging.quality import check_picture, sharpness_and_exposure
from refdgs_pipe.imaging.raw import Development, develop, is_raw, plan_development

_CALLED_PHOTO = (PHOTO_SUFFIX, RAW_SUFFIX, VIDEO_SUFFIX)


@dataclass(frozen=True)
class Plan:
    """How the whole set is treated.

    Args:
        max_side: longer images are reduced to this, pixels.
        placing_side: of photos without poses a picture of this long side is written, pixels, too,
            if theirs is smaller.
        raw: the photos that are camera RAW.
        development: for these.
        linear: whether every photo is RAW, so that the set stays linear.
        inverted_masks: black marks the object.
    """

    max_side: int
    placing_side: int
    raw: frozenset[Path]
    development: Development | None
    linear: bool
    inverted_masks: bool


def plan_set(
    frames: list[Frame], max_side: int, placing_side: int
) -> tuple[Plan, list[Frame], list[Skipped]]:
    """Look at all files once and decide how to treat them alike.

    Returns:
        The plan, the frames to read, and those left out: files that are no photos, and photos that
        the camera wrote as RAW too.
    """
    raw = frozenset(frame.path for frame in frames if is_raw(frame.path))
    stems = {path.with_suffix("") for path in raw}
    kept, skipped = [], []
    for frame in frames:
        path = frame.path
        if path in raw or (sniff(path) and path.with_suffix("") not in stems):
            kept.append(frame)
        elif sniff(path):
            skipped.append(Skipped(frame.source, "the same photo is there as camera RAW", True))
        else:
            called_photo = any(s.fullmatch(path.suffix) for s in _CALLED_PHOTO)
            reason = "empty" if path.stat().st_size == 0 else "damaged or not a photo"
            skipped.append(Skipped(frame.source, reason, not called_photo))
    development = plan_development([(p, read_exif(p)) for p in sorted(raw)]) if raw else None
    inverted = are_inverted(_readable_masks(kept))
    others = any(frame.path not in raw and _has_header(frame.path) for frame in kept)
    plan = Plan(max_side, placing_side, raw, development, bool(raw) and not others, inverted)
    return plan, kept, skipped


def prepare_set(
    frames: list[Frame],
    folder: Path,
    plan: Plan,
    *,
    threads: int,
    progress: Callable[[int, int], object],
) -> list[View | Skipped]:
    """Write every photo below `folder`, several at a time; bad ones become Skipped.

    Args:
        progress: is told how many photos are done, of how many; it may raise to stop.

    Returns:
        What became of each frame, in order.
    """

    def attempt(frame: Frame) -> View | Skipped:
        try:
            return prepare_photo(frame, folder, plan)
        except CaptureError as error:
            return Skipped(frame.source, printable(error))

    results: list[View | Skipped] = []
    pool = ThreadPoolExecutor(threads)
    try:
        for result in pool.map(attempt, frames):
            progress(len(results), len(frames))
            results.append(result)
    finally:
        pool.shutdown(cancel_futures=True)
    return results


def prepare_photo(frame: Frame, folder: Path, plan: Plan) -> View:
    """Write one photo and its mask below `folder`.

    Poses that came with a capture belong to the pixels as stored, so these are not turned.

    Raises:
        CaptureError: the photo or its mask cannot be used, with the reason.
    """
    exif = read_exif(frame.path)
    pixels, orientation = _read(frame, exif, plan)
    if frame.known is None:
        check_picture(pixels, frame.source, linear=plan.linear)
        if frame.path not in plan.raw:
            exif = held_against(exif, *_size(frame.path))
    mask = _mask(frame, pixels, orientation, plan)
    if mask is not None and frame.mask_kind == "alpha" and not _has_alpha(pixels):
        pixels = without_matte(pixels[..., :3], mask)
    stored = (pixels.shape[1], pixels.shape[0])
    is_drawn = frame.mask is not None and frame.mask_kind == "drawn"
    alpha = None if is_drawn else mask
    placing = _write_placing(frame, pixels[..., :3], folder, plan, alpha=alpha)
    pixels = _reduce(pixels[..., :3], plan.max_side, alpha=alpha)
    height, width = pixels.shape[:2]
    write_png(folder / "images" / f"{frame.name}.png", pixels)
    if mask is not None:
        small = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
        write_png(folder / "masks" / f"{frame.name}.png", np.asarray(small, np.uint8))
    unit = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    sharpness, exposure = sharpness_and_exposure(srgb_from_linear(unit) if plan.linear else unit)
    return View(
        name=frame.name,
        file=f"images/{frame.name}.png",
        width=width,
        height=height,
        mask=None if mask is None else f"masks/{frame.name}.png",
        split=frame.split,
        exif=exif,
        sharpness=sharpness,
        exposure=exposure,
        known=_resized_pose(frame.known, stored, (width, height)),
        source=frame.source,
        placing=placing,
        source_size=_upright_size(frame, stored, orientation, plan),
    )


def _upright_size(
    frame: Frame, decoded: tuple[int, int], orientation: int, plan: Plan
) -> tuple[int, int]:
    """Width and height of the user's file, upright; large files may be decoded at a fraction."""
    if frame.path in plan.raw:
        return decoded
    width, height = _size(frame.path)
    return (height, width) if orientation >= 5 else (width, height)


def _write_placing(
    frame: Frame, pixels: Pixels, folder: Path, plan: Plan, *, alpha: U8 | None
) -> str | None:
    """Write the larger picture for structure from motion where one is needed; its file."""
    is_reduced = max(pixels.shape[:2]) > plan.max_side
    if frame.known is not None or plan.max_side >= plan.placing_side or not is_reduced:
        return None
    pixels = _reduce(pixels, plan.placing_side, alpha=alpha)
    if pixels.dtype == np.uint16:
        unit = pixels.astype(np.float32) / np.float32(65535)
        encoded = srgb_from_linear(unit) if plan.linear else unit
        pixels = (encoded * 255).round().astype(np.uint8)
    write_png(folder / "placing" / f"{frame.name}.png", pixels)
    return f"placing/{frame.name}.png"


def _read(frame: Frame, exif: Exif, plan: Plan) -> tuple[Pixels, int]:
    """Pixels (H, W, 3 or 4) and the orientation that was applied."""
    if frame.path in plan.raw and plan.development is not None:
        linear = develop(frame.path, exif, plan.development)
        if plan.linear:
            return linear, 1
        encoded = srgb_from_linear(linear.astype(np.float32) / np.float32(65535))
        return (encoded * 65535).round().astype(np.uint16), 1
    orientation = read_header(frame.path).orientation if frame.known is None else 1
    loose = frame.known is None
    side = max(plan.max_side, plan.placing_side) if loose else None
    return read_photo(frame.path, upright=loose, side=side), orientation


def _size(path: Path) -> tuple[int, int]:
    header = read_header(path)
    return header.width, header.height


def _mask(frame: Frame, pixels: Pixels, orientation: int, plan: Plan) -> U8 | None:
    """The mask at the photo's size, from its file or from the alpha channel."""
    size = (pixels.shape[1], pixels.shape[0])
    if frame.mask is None or (frame.mask_kind == "alpha" and _has_alpha(pixels)):
        if pixels.shape[2] == 3:
            return None
        alpha = (pixels[..., 3] >> 8) if pixels.dtype == np.uint16 else pixels[..., 3]
        if alpha.min() == 255:
            return None
        mask = alpha.astype(np.uint8)
        check_mask(mask, f"the alpha channel of {frame.source}")
        return mask
    mask = _read_mask(frame.mask, frame.mask_kind, inverted=plan.inverted_masks)
    if orientation >= 5 and (mask.shape[0], mask.shape[1]) == size:
        mask = orient(mask, orientation).astype(np.uint8)  # drawn on the pixels as stored
    if abs(mask.shape[1] / mask.shape[0] - size[0] / size[1]) > 0.01 * size[0] / size[1]:
        raise CaptureError(
            f"{frame.mask.parent.name}/{frame.mask.name} is {mask.shape[1]} x {mask.shape[0]} "
            f"but its photo is {size[0]} x {size[1]}: their shapes must agree"
        )
    resized = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(resized, np.uint8)


def _has_alpha(pixels: Pixels) -> bool:
    """Whether something is transparent: then the alpha in a file of its own only repeats it."""
    return pixels.shape[2] == 4 and bool(pixels[..., 3].min() < np.iinfo(pixels.dtype).max)


def _read_mask(path: Path, kind: MaskKind, *, inverted: bool) -> U8:
    if kind == "alpha":
        return read_alpha(path)
    return read_depth_mask(path) if kind == "depth" else read_mask(path, inverted=inverted)


def _reduce(pixels: Pixels, max_side: int, *, alpha: U8 | None) -> Pixels:
    """Average down to at most `max_side`; behind an alpha channel colour is weighted by it."""
    height, width = pixels.shape[:2]
    scale = max_side / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    out: Pixels
    if alpha is None:
        out = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    else:
        weight = alpha.astype(np.float32)[..., None] / np.float32(255) + np.float32(1e-4)
        total = cv2.resize(pixels.astype(np.float32) * weight, size, interpolation=cv2.INTER_AREA)
        weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)[..., None]
        out = (total / weight).round().astype(pixels.dtype)
    return out


def _resized_pose(
    known: KnownPose | None, stored: tuple[int, int], size: tuple[int, int]
) -> KnownPose | None:
    if known is None:
        return None
    scale = np.diag([size[0] / stored[0], size[1] / stored[1], 1.0])
    return replace(known, lens=Lens(scale @ known.lens.K, known.lens.distortion))


def _has_header(path: Path) -> bool:
    """False for a RAW file too damaged to be known as one: it does not make its set a mixed one."""
    try:
        return read_header(path).width > 0
    except CaptureError:
        return False


def _readable_masks(frames: list[Frame]) -> Iterator[U8]:
    for frame in frames:
        if frame.mask is not None and frame.mask_kind == "drawn":
            try:
                yield read_mask(frame.mask)
            except CaptureError:
                continue
