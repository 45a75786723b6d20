"""How each photo was exposed and balanced, from the ground that all of them show.

Phones expose each photo by itself, and balance its white. All later stages compare photos: they
need the brightness and the colour that one setting would have given. The ground tells the factors:
under light that stands still, a place of it keeps its colour from photo to photo.
"""

import numpy as np

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, mapped

SIDE, CELLS = 320, 128  # px that photos are reduced to; of the ground's picture along an edge
REACH = 2.0  # of that picture, radii of the ball
DARK, BRIGHT = 0.05, 0.97  # sRGB: other pixels do not tell
FEWEST = 200  # cells that a photo has to show
ROUNDS = 8
SMALLEST = 0.06  # of a factor's logarithm, in any photo: less is not evened
PARTS = 8  # of the picture along an edge, in which the light may differ
LOOSE = 0.06  # median distance of a photo's parts from its factor, above which it tells nothing
SURE = 6.0  # times that distance: a factor as large tells nevertheless
CLEAR = 3.0  # times that distance: in one photo at least, the factor has to be larger


def gains_of(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    threads: int = 1,
) -> dict[str, tuple[float, float, float]]:
    """Factors of linear RGB that make the photos alike; empty where they are already.

    Args:
        plane: unit normal and offset of the ground, world.
        threads: photos that are worked on at a time; the result does not depend on it.

    Returns:
        Camera's name -> factors. The middle photo keeps its brightness and colour.

    Raises:
        CorruptError: a photo is missing or damaged.
    """
    ground = Ground.under(model.ball, *plane, REACH * model.ball.radius)

    def flat(camera: Camera) -> F32:
        scale = min(1.0, SIDE / max(camera.width, camera.height))
        photo = load_photo(views, model, camera, scale=scale, evened=False)
        told = photo.valid & (photo.rgb > DARK).all(-1) & (photo.rgb < BRIGHT).all(-1)
        logs = np.log(np.maximum(linear_from_srgb(photo.rgb), 1e-4))
        logs = np.where(told[..., None], logs, np.float32(np.nan)).astype(np.float32)
        return ground.flattened(logs, photo.camera, CELLS)

    seen = np.stack(mapped(flat, model.cameras, threads))
    logs, apart = factors(seen)
    size = np.abs(logs).max(1)
    told = np.isfinite(seen[..., 0]).sum((1, 2)) >= FEWEST
    told &= (apart < LOOSE) | (size > SURE * apart)
    clear = size > np.maximum(SMALLEST, CLEAR * apart)
    if not (told & clear).any() or np.median(apart) > LOOSE:  # then the light moves
        return {}
    logs[~told] = 0.0
    named = zip(model.names, np.exp(-logs), strict=True)
    return {name: (float(r), float(g), float(b)) for name, (r, g, b) in named}


def factors(seen: F32) -> tuple[F64, F64]:
    """Logarithms (N, 3) of each photo's factors, and how far parts of it are from them (N,).

    Args:
        seen: (N, n, n, 3) logarithms of the ground's colour in each photo; NaN where unknown.

    Returns:
        0 and infinity for a photo that shows nothing of the ground that another one shows.
    """
    logs, apart = np.zeros((len(seen), 3)), np.full(len(seen), np.inf)
    known = np.isfinite(seen[..., 0])
    shared = known.sum(0) >= 2
    told = known[:, shared].any(1)
    if not told.any():
        return logs, apart
    flat = seen[told][:, shared].astype(np.float64)
    for _ in range(ROUNDS):
        colour = np.nanmedian(flat - logs[told][:, None], 0)
        logs[told] = np.nanmedian(flat - colour, 1)
        logs[told] -= np.median(logs[told], 0)
    for i in np.flatnonzero(told):
        off = np.where(known[i], 0.0, np.nan)
        off[shared] = (seen[i][shared] - logs[i] - colour).mean(-1)
        parts = _parts(off)
        apart[i] = np.median(np.abs(parts)) if len(parts) else np.inf
    return logs, apart


def _parts(values: F64) -> F64:
    """(M,) medians of the square parts of (n, n) values that are mostly known."""
    side = len(values) // PARTS
    blocks = values[: side * PARTS, : side * PARTS].reshape(PARTS, side, PARTS, side)
    parts = blocks.transpose(0, 2, 1, 3).reshape(PARTS**2, -1)
    parts = parts[np.isfinite(parts).mean(1) > 0.5]
    return np.asarray(np.nanmedian(parts, 1))
