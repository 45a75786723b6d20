"""The object's masks, by rounds of evidence, cuts and the solid that they agree on."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.masking.beyond import shown_room
from refdgs_pipe.masking.colours import colour_evidence
from refdgs_pipe.masking.cut import cut
from refdgs_pipe.masking.shots import (
    F32,
    Bools,
    Shot,
    box_around,
    cut_to,
    grown,
    resized,
    whole_shots,
)
from refdgs_pipe.masking.solid import Cells, agreed, grid, pixels_of, silhouette
from refdgs_pipe.masking.table import Evidence, Ground, Table, shown_plane, smooth

TELLING = 0.6  # evidence below which a photo cannot tell whether a cell is empty
SURE = 4.0  # evidence against what cannot be the object


@dataclass(frozen=True)
class Level:
    """One size of working.

    Args:
        side: longest side of the photos, pixels; cells: of the plane's picture; solid: cells.
        denials: for each round the share of the photos that may deny a cell; none makes no solid.
    """

    side: int
    cells: int
    solid: int
    denials: tuple[float, ...]
    margin: float = 0.2


LEVELS = (Level(200, 256, 64, (0.25, 0.15)), Level(400, 384, 96, (0.08, 0.06), 0.5))
LAST = Level(1024, 512, 0, ())
FINE_CELLS = 160
FINE_DENIALS = (0.06, 0.04)
WIDE = 2.2  # radii of the ball that the plane's picture reaches at first
NARROW = 1.9  # reaches of the solid, later
BAND = 0.02  # of a photo's longer side: how far an outline may be off
COLOUR, PRIOR, WEIGHT = 0.5, 0.75, 0.4


@dataclass
class Found:
    """What is known between rounds, for whole photos of any size.

    Args:
        masks: (h, w) in [0, 1]; outlines: (h, w) bool; room: beside the plane.
    """

    masks: list[F32]
    outlines: list[Bools]
    room: list[Evidence] | None
    gains: F32 | None
    reach: float


def object_masks(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    progress: Callable[[int, int], None],
    watch: Callable[[str, Found], None] | None = None,
) -> Found | None:
    """Masks of what stands on a plane, or None where nothing is found.

    Args:
        plane: unit normal and offset, world.
    """
    normal, offset = plane
    found: Found | None = None
    total = sum(len(level.denials) for level in LEVELS) + 1
    done = 0
    for level in LEVELS:
        worker = _Worker(views, model, plane, level, found)
        for deny in level.denials:
            progress(done, total)
            found = worker.round(found, deny)
            done += 1
            if found is None:
                return None
            if watch is not None:
                watch(f"{level.side} {deny}", found)
    progress(done, total)
    assert found is not None
    worker = _Worker(views, model, plane, LAST, found)
    return worker.final(found, grid(model.ball, normal, offset, FINE_CELLS))


class _Worker:
    def __init__(
        self,
        views: Views,
        model: SparseModel,
        plane: tuple[F64, float],
        level: Level,
        found: Found | None,
    ) -> None:
        self.normal, self.offset = plane
        self.level, self.ball = level, model.ball
        self.inner = 1.0 if level.denials else 0.3
        whole = whole_shots(views, model, level.side)
        self.weight = WEIGHT * min(1.0, 400 / max(whole[0].whole))
        if found is None:
            self.shots = whole
        else:
            self.shots = []
            for shot, outline in zip(whole, found.outlines, strict=True):
                large = resized(outline.astype(np.float32), *shot.whole) > 0.5
                box = box_around(large, level.margin)
                self.shots.append(shot if box is None else cut_to(shot, box))
        reach = WIDE * model.ball.radius if found is None else NARROW * found.reach
        ground = Ground.under(self.ball, self.normal, self.offset, reach)
        gains = None
        self.table = Table(ground, level.cells, gains, len(self.shots))
        self.cells = grid(self.ball, self.normal, self.offset, level.solid) if level.solid else None
        self.band = [max(2, round(BAND * max(shot.whole))) for shot in self.shots]

    def evidence(self, found: Found | None) -> tuple[list[F32], list[Bools]]:
        """(H, W) log odds of background, and where anything is known."""
        if found is None:
            ground = shown_plane(self.table.found(self.shots), self.shots, None, seldom=(0.25, 0.5))
        else:
            outlines = self.parts([o.astype(np.float32) for o in found.outlines])
            solid = [grown(o > 0.5, -b) for o, b in zip(outlines, self.band, strict=True)]
            clear = [~grown(o > 0.5, 2 * b) for o, b in zip(outlines, self.band, strict=True)]
            table = self.table.found(self.shots, solid)
            ground = shown_plane(table, self.shots, clear, seldom=(0.1, 0.4))
        values, known = [e.value for e in ground], [e.known for e in ground]
        if found is not None and found.room is not None:
            rooms = self.parts([e.value for e in found.room])
            told = self.parts([e.known.astype(np.float32) for e in found.room])
            for i, (room, tell) in enumerate(zip(rooms, told, strict=True)):
                more = (tell > 0.9) & ~known[i]
                values[i] = np.where(more, room, values[i])
                known[i] = known[i] | more & (smooth(np.abs(room), 1.0) > TELLING)
        return values, known

    def parts(self, images: list[F32]) -> list[F32]:
        """Images of whole photos, of any size, as the shots show them."""
        out = []
        for image, shot in zip(images, self.shots, strict=True):
            left, right, top, bottom = shot.box
            out.append(resized(image, *shot.whole)[top:bottom, left:right])
        return out

    def round(self, found: Found | None, deny: float) -> Found | None:
        assert self.cells is not None
        values, known = self.evidence(found)
        limits = self.limits(found)
        if found is not None:
            masks = self.parts(found.masks)
            outlines = [o > 0.5 for o in self.parts([o.astype(np.float32) for o in found.outlines])]
            colours = colour_evidence(self.shots, masks, outlines, self.band)
            for i, colour in enumerate(colours):
                near = grown(outlines[i], 2 * self.band[i])
                doubt = np.clip(1 - np.abs(values[i]) / 2, 0, 1)
                values[i] = values[i] + COLOUR * doubt * np.where(
                    near, colour, np.maximum(colour, 0)
                )
        data = [np.where(limit, v, SURE) for v, limit in zip(values, limits, strict=True)]
        first = [
            cut(d.astype(np.float32), s.rgb, weight=self.weight)
            for d, s in zip(data, self.shots, strict=True)
        ]
        free, tell = [], []
        for i, shot in enumerate(self.shots):
            reach = max(1, round(0.9 * pixels_of(self.cells.size, shot, self.ball.center)))
            free.append(grown(first[i] > 0.3, reach) & limits[i])
            tell.append(known[i])
        solid = agreed(self.cells, self.shots, free, tell, self.normal, deny=deny)
        if solid.sum() < 50:
            return None
        outlines = [silhouette(self.cells, solid, shot) for shot in self.shots]
        final = [
            self._with_prior(*x) for x in zip(data, outlines, self.shots, self.band, strict=True)
        ]
        points = self.cells.points[solid]
        flat = points - self.ball.center
        flat -= (flat @ self.normal)[:, None] * self.normal
        result = Found(
            [s.placed(m) for s, m in zip(self.shots, final, strict=True)],
            [
                s.placed(o.astype(np.float32)) > 0.5
                for s, o in zip(self.shots, outlines, strict=True)
            ],
            None if found is None else found.room,
            None,
            float(np.linalg.norm(flat, axis=1).max()),
        )
        if self.level is LEVELS[0] and found is not None:
            cover = [grown(o, 2) for o in result.outlines]
            result.room = shown_room(self.shots, self.ball, cover)
        return result

    def limits(self, found: Found | None) -> list[Bools]:
        """(H, W) where the object can be at all."""
        if found is None:
            assert self.cells is not None
            return [silhouette(self.cells, self.cells.inside, shot) for shot in self.shots]
        return [np.ones(shot.valid.shape, bool) for shot in self.shots]

    def _with_prior(self, data: F32, outline: Bools, shot: Shot, band: int) -> F32:
        """(H, W) the mask, near the solid's silhouette."""
        distance = signed_distance(outline) / band
        doubt = np.clip(1 - np.abs(data) / 2, 0.1, 1)
        prior = PRIOR * np.where(distance > 0, self.inner * doubt, 1) * np.clip(distance, -1, 1)
        evidence = np.where(distance < -1, SURE, data - prior)
        return cut(evidence.astype(np.float32), shot.rgb, weight=self.weight)

    def final(self, found: Found, fine: Cells) -> Found:
        """Masks as fine as photos are, of what all of them agree on."""
        values, _ = self.evidence(found)
        masks = self.parts(found.masks)
        outlines = [o > 0.5 for o in self.parts([o.astype(np.float32) for o in found.outlines])]
        colours = colour_evidence(self.shots, masks, outlines, self.band)
        data = []
        for value, colour in zip(values, colours, strict=True):
            data.append(value + COLOUR * np.clip(1 - np.abs(value) / 2, 0, 1) * colour)
        for deny in FINE_DENIALS:
            shots = zip(data, outlines, self.shots, self.band, strict=True)
            masks = [self._with_prior(*shot) for shot in shots]
            free = [
                grown(mask > 0.3, max(1, round(0.5 * pixels_of(fine.size, shot, self.ball.center))))
                for mask, shot in zip(masks, self.shots, strict=True)
            ]
            tell = [np.ones_like(f) for f in free]
            solid = agreed(fine, self.shots, free, tell, self.normal, deny=deny)
            outlines = [silhouette(fine, solid, shot) for shot in self.shots]
            self.band = [max(2, round(b / 2)) for b in self.band]
        shots = zip(data, outlines, self.shots, self.band, strict=True)
        masks = [self._with_prior(*shot) for shot in shots]
        placed = [s.placed(m) for s, m in zip(self.shots, masks, strict=True)]
        lines = [
            s.placed(o.astype(np.float32)) > 0.5 for s, o in zip(self.shots, outlines, strict=True)
        ]
        return Found(placed, lines, found.room, None, found.reach)


def signed_distance(mask: Bools) -> F32:
    """(H, W) pixels to the mask's edge, positive inside."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(inside - outside, np.float32)


def agreement(found: Found) -> tuple[float, float]:
    """How well the masks agree with the solid that all of them show: mean and worst tenth.

    Intersection over union of each mask with the solid's silhouette.
    """
    shares = []
    for mask, outline in zip(found.masks, found.outlines, strict=True):
        object_ = mask > 0.5
        union = int((object_ | outline).sum())
        shares.append(float((object_ & outline).sum()) / union if union else 0.0)
    return float(np.mean(shares)), float(np.quantile(shares, 0.1))
