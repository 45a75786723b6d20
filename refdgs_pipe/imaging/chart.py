"""White balance and colour from a chart of 24 patches that a photo shows."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.files.images import Pixels, read_png, write_png
from refdgs_pipe.imaging.color_difference import F64, ciede2000, lab_from_linear

LOOK_AT = 1600  # px of the long side in which a chart is looked for
LEAST_SIDE = 60.0  # px of a chart's longer side
CLIPPED = (0.004, 0.96)  # linear: patches outside tell nothing
LEAST_PATCHES = 18
WORST_AFTER = 5.0  # mean colour difference after correction: above, it is no chart
WORST_BEFORE = 30.0  # the same before, white balance aside
RANGE = 8.0  # largest gain by the smallest, of the correction
GREYS = slice(18, 24)  # the last row, white to black
NEUTRAL = slice(20, 22)  # of these the two in the middle
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB


@dataclass(frozen=True)
class ChartFix:
    """What a chart says about the colours of a set.

    Args:
        photo: file name of the photo that was used.
        matrix: (3, 3) from linear sRGB as photographed to linear sRGB; greys keep their luminance.
        before, after: mean CIEDE2000 of the patches, brightness aside.
        patches: how many were used.
    """

    photo: str
    matrix: F64
    before: float
    after: float
    patches: int


def fix_by_chart(folder: Path, files: Iterable[str], *, linear: bool) -> ChartFix | None:
    """Look for a chart in photos and fit the correction; None if no photo shows one.

    Where several photos do, the one that fits best is used.

    Args:
        files: PNGs below `folder`; linear: whether these are in linear light, else sRGB.

    Raises:
        CorruptError: an image is missing or damaged.
    """
    fixes = []
    for file in sorted(files):
        patches = patches_in(read_png(folder / file), linear=linear)
        fix = None if patches is None else fitted(patches, file)
        if fix is not None:
            fixes.append(fix)
    return min(fixes, key=lambda fix: fix.after, default=None)


def chart_figures(views: Views, chart: Literal["auto", "off"]) -> dict[str, str | int]:
    """Correct the views' images in place if a photo shows a chart, and say by how much.

    Pictures whose background was removed are left alone.

    Returns:
        Empty where there is no chart.

    Raises:
        CorruptError: an image is missing or damaged.
    """
    if chart == "off" or views.background == "removed" or views.has_known_poses:
        return {}
    files, linear = [view.file for view in views.items], views.color_space == "linear"
    fix = fix_by_chart(views.folder, files, linear=linear)
    if fix is None:
        return {}
    apply_fix(fix, views.folder, files, linear=linear)
    source = next(view.source for view in views.items if view.file == fix.photo)
    words = f"in {source}: colour difference {fix.before:.1f} before, {fix.after:.1f} after"
    return {"colour chart": words}


def patches_in(pixels: Pixels, *, linear: bool) -> F64 | None:
    """(24, 3) linear RGB of what looks like a chart in a photo (H, W, 3), or None.

    Rows go from dark skin to black, as on the X-Rite ColorChecker Classic.
    """
    unit = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    scale = min(1.0, LOOK_AT / max(unit.shape[:2]))
    if scale < 1:
        unit = cv2.resize(unit, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    encoded = srgb_from_linear(unit) if linear else unit
    picture = np.ascontiguousarray(np.round(encoded[..., ::-1] * 255).astype(np.uint8))
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if min(picture.shape[:2]) < LEAST_SIDE or not detector.process(picture, 1):
        return None
    chart = detector.getBestColorChecker()
    if float(np.ptp(np.asarray(chart.getBox()), axis=0).max()) < LEAST_SIDE:
        return None
    means = np.asarray(chart.getChartsRGB(), np.float64)[:, 1].reshape(24, 3)
    return linear_from_srgb((means / 255).astype(np.float32)).astype(np.float64)


def fitted(patches: F64, photo: str = "") -> ChartFix | None:
    """The correction that patches (24, 3, linear RGB) ask for; None if they are no chart's."""
    good = ((patches > CLIPPED[0]) & (patches < CLIPPED[1])).all(axis=1)
    grey = patches[GREYS].mean(axis=1)
    if good.sum() < LEAST_PATCHES or not (np.diff(grey) < 0).all():
        return None
    wanted = reference()
    kept = np.where(good)[0]
    matrix = _matrix(patches[kept], wanted[kept])
    if matrix is None:
        return None
    gains = np.linalg.svd(matrix, compute_uv=False)
    if gains.max() > RANGE * gains.min():
        return None
    balanced = patches * (wanted[NEUTRAL].mean(axis=0) / patches[NEUTRAL].mean(axis=0))
    if _difference(balanced[kept], wanted[kept]) > WORST_BEFORE:
        return None
    after = _difference(patches[kept] @ matrix.T, wanted[kept])
    if after > WORST_AFTER:
        return None
    neutral = patches[NEUTRAL].mean(axis=0)
    keep = float(LUMINANCE @ neutral) / float(LUMINANCE @ (matrix @ neutral))
    level = float(LUMINANCE @ wanted[NEUTRAL].mean(axis=0)) / float(LUMINANCE @ neutral)
    before = _difference(level * patches[kept], wanted[kept])
    return ChartFix(photo, matrix * keep, before, after, len(kept))


def apply_fix(fix: ChartFix, folder: Path, files: Iterable[str], *, linear: bool) -> None:
    """Correct the PNGs below `folder` in place, in linear light."""
    for file in files:
        write_png(folder / file, corrected(read_png(folder / file), fix, linear=linear))


def corrected(pixels: Pixels, fix: ChartFix, *, linear: bool) -> Pixels:
    """A photo (H, W, 3) with the correction applied, of the same type."""
    full = np.iinfo(pixels.dtype).max
    unit = pixels.astype(np.float32) / np.float32(full)
    light = unit if linear else linear_from_srgb(unit)
    light = np.clip(light @ fix.matrix.T.astype(np.float32), 0, 1)
    levels = np.round((light if linear else srgb_from_linear(light)) * full)
    return levels.astype(np.uint16) if pixels.dtype == np.uint16 else levels.astype(np.uint8)


def reference() -> F64:
    """(24, 3) the patches of an X-Rite ColorChecker Classic in linear sRGB, as OpenCV has them."""
    any_patches = np.linspace(0.1, 0.9, 72).reshape(24, 1, 3)
    model = cv2.ccm.ColorCorrectionModel(any_patches, cv2.ccm.COLORCHECKER_MACBETH)
    model.setColorSpace(cv2.ccm.COLOR_SPACE_SRGB)
    model.setLinearization(cv2.ccm.LINEARIZATION_IDENTITY)
    model.compute()
    return np.asarray(model.getRefLinearRGB(), np.float64).reshape(24, 3)


def _matrix(patches: F64, wanted: F64) -> F64 | None:
    """(3, 3) that brings patches nearest to what is wanted by CIEDE2000; None if nothing does."""
    count = len(patches)
    lab = cv2.ccm.COLOR_SPACE_SRGBL
    model = cv2.ccm.ColorCorrectionModel(
        patches.reshape(count, 1, 3).copy(), wanted.reshape(count, 1, 3).copy(), lab
    )
    model.setColorSpace(cv2.ccm.COLOR_SPACE_SRGB)
    model.setLinearization(cv2.ccm.LINEARIZATION_IDENTITY)
    model.setCcmType(cv2.ccm.CCM_LINEAR)
    model.setDistance(cv2.ccm.DISTANCE_CIE2000)
    model.setSaturatedThreshold(0.0, 1.0)
    try:
        model.compute()
    except cv2.error:
        return None
    matrix = np.asarray(model.getColorCorrectionMatrix(), np.float64).T
    return matrix if np.isfinite(matrix).all() else None


def _difference(linear: F64, wanted: F64) -> float:
    return float(ciede2000(lab_from_linear(linear), lab_from_linear(wanted)).mean())
