"""What the plane that the object stands on looks like, and where each photo shows it.

Photos of a textured plane agree on it wherever nothing stands in front of it. A picture of the
plane that most photos agree on, drawn from each photo's place, says for every pixel whether the
photo shows the plane there, or something else. A reflection does not agree, whatever it shows.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch

from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools, Shot, mapped

TOLERANCES = (0.25, 0.15)  # of log colour, within which photos agree: at first, then
CANDIDATES = 12  # photos whose colour is proposed where it is not known who sees the plane
GAIN_PIXELS = 8000
SPREAD = 0.04  # of log colour, about the true one
TEXTURE = 0.12  # of log brightness, by which a place is fully textured
LIMIT = 3.0  # of the evidence of one pixel
BINS = (-1.0, 0.15, 0.35, 0.6, 0.85, 1.01)  # of texture, each judged by its own misses
MISSES = 0.12  # share of the plane's own pixels that may be taken for something else
MOST_MISSED = 1.6  # of evidence, that the misses may take
TYPICAL = 1.5  # evidence of the plane's own pixels, at least
LEAST_PIXELS = 500
DARKEST = 2.5  # of log colour, by which a shadow darkens the plane at most
Blur = tuple[float, float]
"""Pixels (sigma) over which likeness of colour and of texture are averaged."""
BLUR: Blur = (1.3, 1.8)


@dataclass(frozen=True)
class Evidence:
    """Of one photo: whether it shows what lies behind the object.

    Args:
        value: (H, W) log odds that it does; 0 where nothing is known.
        known: (H, W) whether anything is known.
    """

    value: F32
    known: Bools


class Table:
    """A picture of the plane, in log colour, and each photo's brightness on it.

    Args:
        cells: along an edge of the picture; count: of the photos.
        covered: (cells, cells) where the object stands for sure; None if nothing is known of that.
    """

    def __init__(
        self,
        ground: Ground,
        cells: int,
        count: int,
        threads: int = 1,
        covered: Bools | None = None,
    ) -> None:
        self.ground, self.cells, self.threads = ground, cells, threads
        place = (np.mgrid[0:cells, 0:cells] + 0.5) / cells * 2 - 1
        y, x = place * ground.radius
        basis = [np.ones_like(x), x, y, x * x, x * y, y * y]
        self._basis = np.stack(basis, -1).astype(np.float32)
        self.gains = np.zeros((count, 6), np.float32)
        self.colour = np.zeros((cells, cells, 3), np.float32)
        self.share = np.zeros((cells, cells), np.float32)
        self.covered = np.zeros((cells, cells), bool) if covered is None else covered

    def found(self, shots: list[Shot], hidden: list[Bools] | None = None) -> "Table":
        """Find the picture.

        Args:
            hidden: (H, W) where each photo shows the object for sure; None at first.
        """
        if hidden is None:
            seen = self.seen(shots, None)
            level = np.array([np.nanmedian(s) for s in seen])
            shift = level - np.median(level)
            self.gains[:, 0] = np.where(np.abs(shift) > 0.1, shift, 0)
            for tolerance in TOLERANCES:
                seen = self.seen(shots, None)
                self._agree(seen, tolerance)
                self._fit_gains(seen)
            return self
        seen = self.seen(shots, hidden)
        count = np.isfinite(seen[..., 0]).sum(0)
        self.colour = torch.from_numpy(seen).nanmedian(0).values.numpy()
        near = (np.abs(seen - self.colour).max(-1) < TOLERANCES[-1]).sum(0)
        enough = np.clip((count - 1.5) / max(2.0, 0.06 * len(shots)), 0, 1)
        self.share = np.asarray(near / np.maximum(count, 1) * enough, np.float32)
        self._fit_gains(seen)
        return self

    def seen(self, shots: list[Shot], hidden: list[Bools] | None) -> F32:
        """(N, n, n, 3) the plane as each photo shows it; NaN where it does not."""
        n = self.cells
        out = np.empty((len(shots), n, n, 3), np.float32)

        def flatten(i: int) -> None:
            shot = shots[i]
            shown = shot.valid if hidden is None else shot.valid & ~hidden[i]
            logs = np.where(shown[..., None], shot.logs, np.float32(np.nan))
            flat = self.ground.flattened(logs, shot.camera, n)
            out[i] = flat - (self._basis @ self.gains[i])[..., None]

        mapped(flatten, range(len(shots)), self.threads)
        return out

    def _agree(self, seen: F32, tolerance: float) -> None:
        """The colour near which most photos are, and how large a share of them that is."""
        stack = torch.from_numpy(seen)
        pick = np.linspace(0, len(seen) - 1, min(CANDIDATES, len(seen))).round().astype(int)
        best = torch.full(stack.shape[1:3], -1)
        colour = torch.full(stack.shape[1:], torch.nan)
        for i in pick:
            votes = torch.zeros(stack.shape[1:3], dtype=torch.long)
            for other in stack:
                votes += (other - stack[i]).abs().amax(-1) < tolerance
            better = (votes > best) & ~stack[i, ..., 0].isnan()
            best = torch.where(better, votes, best)
            colour = torch.where(better[..., None], stack[i], colour)
        near = (stack - colour).abs().amax(-1) < tolerance
        count = near.sum(0)
        mean = torch.where(near[..., None], stack, 0).sum(0) / count.clamp(min=1)[..., None]
        self.colour = torch.where(count[..., None] > 0, mean, torch.nan).numpy()
        seen_by = (~stack[..., 0].isnan()).sum(0)
        self.share = (count / seen_by.clamp(min=1)).float().numpy()

    def _fit_gains(self, seen: F32) -> None:
        """How much brighter each photo is: a quadratic over the plane, outliers left out."""
        for i, one in enumerate(seen):
            apart = (one - self.colour).mean(-1)
            use = np.isfinite(apart) & (self.share > 0.3) & (np.abs(apart) < 0.3)
            X, y = self._basis[use], apart[use]
            if len(y) < 300:
                continue
            thin = max(1, len(y) // GAIN_PIXELS)
            X, y = X[::thin], y[::thin]
            for _ in range(3):
                fit = np.linalg.lstsq(X, y, rcond=None)[0]
                miss = np.abs(y - X @ fit)
                keep = miss < max(0.03, 2 * float(np.median(miss)))
                X, y = X[keep], y[keep]
            self.gains[i] += fit.astype(np.float32)

    def drawn_cover(self, shot: Shot) -> Bools:
        """(H, W) the pixels that show where the object stands, at its foot or before it."""
        return self.ground.drawn(self.covered.astype(np.float32), shot.camera, 0.0) > 0.5

    def drawn(self, i: int, shot: Shot) -> tuple[F32, F32]:
        """(H, W, 3) the plane as photo i would show it, NaN where it has none; (H, W) its share."""
        colour = (self.colour + (self._basis @ self.gains[i])[..., None]).astype(np.float32)
        camera = shot.camera
        return self.ground.drawn(colour, camera), self.ground.drawn(self.share, camera, 0.0)


def shown_plane(
    table: Table,
    shots: list[Shot],
    reference: list[Bools] | None,
    *,
    seldom: tuple[float, float],
    blur: Blur = BLUR,
    shadows: list[Bools] | None = None,
) -> list[Evidence]:
    """The evidence of all photos, so that the plane's own pixels count as seen.

    What is doubtful where the plane is certain (blurred print, a grazing view) is doubtful
    elsewhere as well: for each degree of texture, the misses over the reference set the zero.

    Args:
        reference: (H, W) where each photo shows no object for sure; None takes everything.
        seldom: share of the photos that agree on a place: from nothing known to fully known.
        blur: the less, the nearer to the object's edge, and the noisier.
        shadows: (H, W) where each photo may show the plane darker; None: nowhere.
    """

    def judge(i: int) -> tuple[F32, F32, F32]:
        dark = None if shadows is None else shadows[i]
        return _judged(shots[i], *table.drawn(i, shots[i]), blur, dark)

    judged = mapped(judge, range(len(shots)), table.threads)
    low, high = seldom
    values, textures, shares = ([j[k] for j in judged] for k in range(3))
    certain = [share > 0.6 for share in shares]
    if reference is not None:
        certain = [c & r for c, r in zip(certain, reference, strict=True)]
    for first, last in pairwise(BINS):
        within = [(t > first) & (t <= last) for t in textures]
        sample = np.concatenate([v[c & w] for v, c, w in zip(values, certain, within, strict=True)])
        if len(sample) < LEAST_PIXELS:
            continue
        zero = float(np.clip(np.quantile(sample, MISSES), 0, MOST_MISSED))
        typical = float(np.median(sample)) - zero
        scale = np.clip(TYPICAL / max(typical, 1e-3), 1, 5)
        for value, where in zip(values, within, strict=True):
            value[where] = scale * (value[where] - zero)
    out = []
    for shot, value, share in zip(shots, values, shares, strict=True):
        sure = np.clip((share - low) / (high - low), 0, 1)
        other = np.clip((share - high) / (0.8 - high), 0, 1)  # against a plane that all agree on
        steep = np.where(value < 0, value.clip(-TYPICAL) * other, value.clip(None, LIMIT) * sure)
        covers = table.drawn_cover(shot)
        steep = np.where(covers, np.minimum(steep, 0), steep)  # evidence for it does not count
        out.append(Evidence(np.asarray(steep, np.float32), (share > low) | covers))
    return out


def _judged(
    shot: Shot, picture: F32, share: F32, blur: Blur, dark: Bools | None = None
) -> tuple[F32, F32, F32]:
    """Evidence, texture and share (H, W) of one photo.

    In a shadow the plane keeps its hue and its texture, and is darker.
    """
    share = np.where(np.isfinite(picture[..., 0]), share, 0).astype(np.float32)
    picture = np.nan_to_num(picture)
    likeness = alike(shot.logs, picture)
    agree, texture = same_texture(shot.logs.mean(-1), picture.mean(-1), blur[1])
    textured = 3 * texture * np.clip(agree - 0.35, -0.6, 0.6)
    value = 3.5 * (smooth(likeness, blur[0]) - 0.45) + textured
    if dark is not None and dark.any():
        darker = np.clip(smooth((picture - shot.logs).mean(-1), 2 * blur[1]), 0, DARKEST)
        shaded = smooth(alike(shot.logs + darker[..., None], picture), blur[0])
        value = np.where(dark, np.maximum(value, 3.5 * (shaded - 0.45) + textured), value)
    return value.astype(np.float32), texture, share


def alike(logs: F32, picture: F32) -> F32:
    """(H, W) 0 to 1: how well colours agree, if the picture may be misplaced by a pixel."""
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(picture, kernel), cv2.dilate(picture, kernel)
    placed = np.maximum(np.maximum(low - logs, logs - high), 0).max(-1)
    straight = np.abs(logs - picture).max(-1)
    miss = 0.5 * placed + 0.25 * np.minimum(straight, 3 * placed + 0.1)
    return np.asarray(np.exp(-0.5 * (miss / SPREAD) ** 2), np.float32)


def same_texture(one: F32, other: F32, sigma: float) -> tuple[F32, F32]:
    """(H, W) normalised correlation over a few pixels, and 0 to 1 how textured `other` is."""
    m1, m2 = smooth(one, sigma), smooth(other, sigma)
    v1 = smooth(one * one, sigma) - m1 * m1
    v2 = smooth(other * other, sigma) - m2 * m2
    both = smooth(one * other, sigma) - m1 * m2
    agree = both / np.sqrt(np.maximum(v1, 1e-4) * np.maximum(v2, 1e-4))
    texture = np.clip(contrast(other, sigma) / TEXTURE, 0, 1)
    return agree.astype(np.float32), texture.astype(np.float32)


def contrast(image: F32, sigma: float) -> F32:
    """(H, W) standard deviation over a few pixels."""
    mean = smooth(image, sigma)
    variance = smooth(image * image, sigma) - mean * mean
    return np.asarray(np.sqrt(np.maximum(variance, 0)), np.float32)


def smooth(image: F32, sigma: float) -> F32:
    """(H, W) blurred, sigma in pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)
