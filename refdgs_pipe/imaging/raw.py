"""Camera RAW to linear light, the same way for every photo of a set (LibRaw through rawpy)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rawpy
from numpy.typing import NDArray

from refdgs_pipe.artifacts.views import Exif
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import MAX_PIXELS
from refdgs_pipe.files.kinds import RAW_SUFFIX, sniff
from refdgs_pipe.files.tiff import is_raw_tiff
from refdgs_pipe.formatting import printable
from refdgs_pipe.trouble import raise_if_machine


@dataclass(frozen=True)
class Development:
    """One white balance for the set, and the exposure that all photos are brought to.

    Args:
        white_balance: four channel multipliers.
        exposure: reference exposure (seconds * ISO / f-number squared), or None to leave as is.
    """

    white_balance: tuple[float, float, float, float]
    exposure: float | None


def is_raw(path: Path) -> bool:
    """Whether it is camera RAW that LibRaw reads. Many RAW formats are TIFFs by their first bytes.

    A TIFF is RAW if its tags say so, or if a camera's suffix says so, as old makers' tags do not.
    """
    kind = sniff(path)
    if kind not in ("raw", "tiff"):
        return False
    if kind == "tiff" and not (is_raw_tiff(path) or RAW_SUFFIX.fullmatch(path.suffix)):
        return False
    try:
        with path.open("rb") as file, rawpy.imread(file):
            return True
    except rawpy.LibRawError as error:
        raise_if_machine(error)
        return kind == "raw"


def plan_development(photos: list[tuple[Path, Exif]]) -> Development:
    """Median white balance and median exposure of a set; photos that do not open are left out."""
    balances = []
    for path, _ in photos:
        try:
            with path.open("rb") as file, rawpy.imread(file) as raw:
                balance = list(raw.camera_whitebalance)
                usable = balance[0] > 0 and balance[1] > 0 and balance[2] > 0
                balances.append(balance if usable else list(raw.daylight_whitebalance))
        except rawpy.LibRawError as error:
            raise_if_machine(error)
            continue
    if not balances:
        return Development((1.0, 1.0, 1.0, 1.0), None)
    middle = np.median(np.array([_normalized(b) for b in balances]), axis=0)
    exposures = [value for _, exif in photos if (value := exposure_of(exif)) is not None]
    differ = len(exposures) == len(photos) and max(exposures) > 1.02 * min(exposures)
    reference = float(np.median(exposures)) if differ else None
    r, g, b, g2 = (float(v) for v in middle)
    return Development((r, g, b, g2), reference)


def develop(path: Path, exif: Exif, plan: Development) -> NDArray[np.uint16]:
    """Decode to upright linear sRGB primaries, (H, W, 3) uint16; the sensor's white is 65535.

    Raises:
        CaptureError: truncated, damaged, or unreasonably large.
    """
    try:
        with path.open("rb") as file, rawpy.imread(file) as raw:
            if raw.sizes.width * raw.sizes.height > MAX_PIXELS:
                raise CaptureError(
                    printable(f"{path.name}: {raw.sizes.width} x {raw.sizes.height} pixels")
                )
            linear = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                output_bps=16,
                user_wb=list(plan.white_balance),
                highlight_mode=rawpy.HighlightMode.Clip,
                output_color=rawpy.ColorSpace.sRGB,
                demosaic_algorithm=rawpy.DemosaicAlgorithm.AHD,
                adjust_maximum_thr=0.0,  # otherwise white depends on the photo's content
            )
    except rawpy.LibRawError as error:
        raise_if_machine(error)
        reason = error.args[0] if error.args else error
        text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        name = printable(path.name)
        raise CaptureError(f"{name}: {text}. Copy it again from the card") from None
    own = exposure_of(exif)
    if plan.exposure is None or own is None:
        return np.asarray(linear, np.uint16)
    scaled = linear.astype(np.float32) * np.float32(plan.exposure / own)
    return np.asarray(np.clip(scaled, 0, 65535).round(), np.uint16)


def exposure_of(exif: Exif) -> float | None:
    """Seconds * ISO / f-number squared: proportional to how bright the sensor renders a scene."""
    if exif.exposure_s is None:
        return None
    return exif.exposure_s * (exif.iso or 100.0) / (exif.aperture or 1.0) ** 2


def _normalized(balance: list[float]) -> list[float]:
    green = balance[1]
    return [balance[0] / green, 1.0, balance[2] / green, (balance[3] or green) / green]
