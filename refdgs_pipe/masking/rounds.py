"""The object's masks, by rounds of evidence, cuts and the solid that they agree on."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import (
    F32,
    Bools,
    Shot,
    cut_round,
    grown,
    mapped,
    resized,
    whole_shots,
)
from refdgs_pipe.masking.beside import without_bystanders
from refdgs_pipe.masking.beyond import Room, is_plain, shown_room
from refdgs_pipe.masking.colours import colour_evidence, with_colour
from refdgs_pipe.masking.contact import heard_of, low, standing, upright, without_bites
from refdgs_pipe.masking.cut import cut, signed_distance, well_inside, without_false_holes
from refdgs_pipe.masking.foot import WIDE, Foot
from refdgs_pipe.masking.held import held
from refdgs_pipe.masking.levels import LAST, LEVELS, Level
from refdgs_pipe.masking.odds import calibrated
from refdgs_pipe.masking.solid import (
    agreed,
    ball_of,
    covering,
    grid,
    pixels_of,
    shadow,
    silhouette,
)
from refdgs_pipe.masking.table import Evidence, Table, shown_plane, smooth

TELLING = 0.6  # evidence below which the room cannot tell whether a cell is empty
SURE = 4.0  # evidence against what cannot be the object
NARROW = 1.9  # reaches of the solid, later, at least
BEHIND = 1.0  # of a point's height above the plane: how far behind it photos show the plane
BAND = 0.02  # of a photo's longer side: how far an outline may be off
CERTAIN = 1.0  # evidence for the object, from which on a photo has to show something solid
PRIOR = 0.75  # of the evidence: the solid's silhouette
INNER = 0.7  # of the silhouette's prior inside, at last
FREE = 0.3  # of a mask, above which it denies nothing
EDGE = 0.5  # of a cell: so far inside its outline the solid is sure
LEAST_CELLS = 50
ROUNDS = sum(len(level.denials) for level in LEVELS) + 1
FIRST_SELDOM, SELDOM = (0.25, 0.5), (0.1, 0.4)


@dataclass(frozen=True)
class Found:
    """What is known of the object after a round, for whole photos at any size.

    Args:
        masks: (h, w) in [0, 1] for each camera of the model.
        outlines: (h, w) the silhouettes of the solid.
        room: evidence beside the plane; None before it is looked for.
        reach: how far from the ball's centre photos show the plane behind the solid, world units.
        ball: round the solid, with room to spare.
        shadows: (h, w) where the solid throws a flash's shadow; None without one.
        beside: things beside the object that were left out.
    """

    masks: list[F32]
    outlines: list[Bools]
    room: list[Room] | None
    reach: float
    ball: Ball
    shadows: list[Bools] | None = None
    beside: int = 0


def solved(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    stands: Foot,
    begins: Callable[[], None],
    *,
    threads: int = 1,
    light: Lighting | None = None,
) -> Found | None:
    """Masks of what stands on a plane for one explanation of its foot; None if nothing is found.

    Each round tells from the plane, the room and the colours what each pixel shows, cuts every
    photo, and keeps of the solid what few photos deny.

    Args:
        plane: unit normal and offset, world.
        stands: where the object stands, as far as the plane's picture tells.
        begins: called before each of the `ROUNDS` rounds; may raise.
        threads: photos that are worked on at a time; the result does not depend on it.
        light: a flash, whose shadow moves with it, or a turntable; None for a still light.
    """
    found: Found | None = None
    for level in LEVELS:
        worker = _Worker(views, model, plane, level, found, threads, stands, light)
        for deny in level.denials:
            begins()
            found = worker.round(found, deny)
            if found is None:
                return None
        if found is not None and found.room is None:
            found = worker.with_room(found)
    begins()
    if found is None:
        return None
    return _Worker(views, model, plane, LAST, found, threads, stands, light).final(found)


@dataclass(frozen=True)
class _Told(Evidence):
    """What a photo tells.

    Args:
        mirrors: (H, W) where it may show a mirror, which has the colours of a plain room: where it
            shows neither plane nor room, or where the solid is and it is not sure of the room.
        beside: (H, W) where the room is asked, not the plane.
    """

    mirrors: Bools
    beside: Bools


class _Worker:
    """The photos of one level, and what they show of the plane."""

    def __init__(
        self,
        views: Views,
        model: SparseModel,
        plane: tuple[F64, float],
        level: Level,
        found: Found | None,
        threads: int,
        stands: Foot,
        light: Lighting | None,
    ) -> None:
        self.normal, self.offset = self.plane = plane
        self.lamp = None if light is None else light.lamp
        self.turns = light is not None and light.kind == "turntable"
        self.level, self.ball, self.threads = level, model.ball, threads
        self.inner = INNER if level is LAST else 1.0
        whole = whole_shots(views, model, level.side)
        if found is None:
            self.shots = list(whole)
        else:
            pairs = zip(whole, found.outlines, strict=True)
            self.shots = [cut_round(*pair, level.margin) for pair in pairs]
        self.weight = level.weight * min(1.0, 400 / max(self.shots[0].whole))
        self.band = [max(2, round(BAND * max(shot.whole))) for shot in self.shots]
        reach = WIDE * model.ball.radius if found is None else found.reach
        ground = Ground.under(self.ball, *plane, reach)
        covered, self.below = (of(ground, level.cells) for of in (stands.on, stands.below))
        self.sure = stands.sure(ground, level.cells)
        self.table = Table(ground, level.cells, len(self.shots), threads, covered)
        within = found.ball if found is not None and level is LAST else self.ball
        self.cells = grid(within, *plane, level.solid)

    def round(self, found: Found | None, deny: float) -> Found | None:
        """Cut every photo, and find the solid; None if there is none."""
        if found is None:
            table = self.table.found(self.shots)
            table.share[self.below] = 0  # what is seen there is no picture of the plane
            evidence = shown_plane(table, self.shots, None, seldom=FIRST_SELDOM)
            known = [e.known for e in evidence]
            limits = [silhouette(self.cells, self.cells.inside, shot) for shot in self.shots]
            values = [
                np.where(limit, e.value, np.float32(SURE))
                for e, limit in zip(evidence, limits, strict=True)
            ]
        else:
            told = self._evidence(found)
            limits = [np.ones(shot.valid.shape, bool) for shot in self.shots]
            values, known = self._with_colours(told, found), [one.known for one in told]
        masks = self._cuts(values)
        free = [m & limit for m, limit in zip(self._free(masks), limits, strict=True)]
        solid = agreed(self.cells, self.shots, free, known, self.normal, deny=deny)
        if solid.sum() < LEAST_CELLS:
            return None
        if found is not None:
            solid = self._covering(solid, free, known, values)
        outlines = self._silhouettes(solid)
        final = self._near_outlines(values, outlines)
        return self._placed(final, outlines, solid, None if found is None else found.room)

    def with_room(self, found: Found) -> Found:
        """Add what the room behind the object tells; the level's photos are whole."""
        cover = [grown(outline, 2) for outline in found.outlines]
        return replace(found, room=shown_room(self.shots, self.ball, cover, self.threads))

    def final(self, found: Found) -> Found | None:
        """Masks as fine as photos are, of what all of them agree on."""
        evidence = self._held(self._evidence(found))
        values, known = self._with_colours(evidence, found), [e.known for e in evidence]
        outlines, proven = self._parts_of(found.outlines), self._proven()
        solid, bites, beside = self.cells.inside, self.cells.inside, 0
        for number, deny in enumerate(self.level.denials):
            if number:  # cells as small as the solid allows
                within = ball_of(self.cells.points[solid], self.cells.size)
                self.cells = grid(within, *self.plane, self.level.solid)
            masks = self._near_outlines(values, outlines)
            free = self._free(masks)
            solid = agreed(self.cells, self.shots, free, known, self.normal, deny=deny)
            if solid.sum() < LEAST_CELLS:
                return None
            solid = self._covering(solid, free, known, values)
            whole, heard = solid, heard_of(free, known, proven)
            if proven is not None:
                told = (self.cells, solid, self.shots, free, known, heard)
                whole = without_bites(*told, self.plane, deny=deny)
            whole = upright(self.cells, whole, self.shots, free, heard, self.plane)
            bites = whole & ~solid
            solid = standing(self.cells, whole, self.shots, free, known, self.plane)
            solid, things = without_bystanders(self.cells, solid, self.plane, self.ball.center)
            beside = max(beside, things)
            outlines = self._silhouettes(solid)
            self.band = [max(2, round(band / 2)) for band in self.band]
        foot = solid & (low(self.cells, *self.plane) | bites)
        values = self._with_contact(values, foot, outlines)
        masks = self._near_outlines(values, outlines)
        return replace(self._placed(masks, outlines, solid, found.room), beside=beside)

    def _evidence(self, found: Found) -> list[_Told]:
        """What the plane tells, and the room where the plane does not."""
        outlines = self._parts_of(found.outlines)
        inner = [grown(o, -band) for o, band in zip(outlines, self.band, strict=True)]
        clear = [~grown(o, 2 * band) for o, band in zip(outlines, self.band, strict=True)]
        table = self.table.found(self.shots, inner)
        dark = None if found.shadows is None else self._parts_of(found.shadows)
        planes = shown_plane(
            table, self.shots, clear, seldom=SELDOM, blur=self.level.blur, shadows=dark
        )
        told = calibrated(planes, self.shots, inner, clear)
        planes = [
            Evidence(np.where(self.table.drawn_cover(shot), before.value, now.value), now.known)
            for shot, before, now in zip(self.shots, planes, told, strict=True)
        ]
        if found.room is None:
            return [_Told(p.value, p.known, *np.zeros((2, *p.known.shape), bool)) for p in planes]
        rooms = self._parts([room.value for room in found.room])
        known = self._parts([room.known.astype(np.float32) for room in found.room])
        apart = self._parts_of([room.apart for room in found.room])
        beside = [(k > 0.9) & ~plane.known for k, plane in zip(known, planes, strict=True)]
        in_plain_room = is_plain(self.shots, [b & c for b, c in zip(beside, clear, strict=True)])
        out = []
        parts = zip(planes, rooms, beside, apart, outlines, strict=True)
        for plane, room, there, alone, outline in parts:
            sure = plane.known | (there & (smooth(np.abs(room), 1.0) > TELLING))
            value = np.where(there, room, plane.value)
            likely = (value < 0) | (outline & there & (value < TELLING))
            mirrors = (alone & ~sure) | (likely & in_plain_room)
            out.append(_Told(value, sure, mirrors, there))
        return out

    def _held(self, evidence: list[_Told]) -> list[_Told]:
        """The evidence, with what photos from above hold for solid: a mirror may be there."""
        values, asked = [e.value for e in evidence], [e.known & ~e.beside for e in evidence]
        out = []
        hulls = held(self.cells, self.shots, values, asked)
        for one, shot, hull in zip(evidence, self.shots, hulls, strict=True):
            inside = well_inside(hull, self._edge(shot))
            out.append(replace(one, mirrors=one.mirrors | (inside & one.beside)))
        return out

    def _edge(self, shot: Shot) -> float:
        """Pixels inside its outline, from which on the solid is sure."""
        return EDGE * pixels_of(self.cells.size, shot, self.ball.center)

    def _with_colours(self, evidence: list[_Told], found: Found) -> list[F32]:
        """(H, W) the evidence, and that of colours where it is weak; far off only one way."""
        outlines = self._parts_of(found.outlines)
        colours = colour_evidence(self.shots, self._parts(found.masks), outlines, self.band)
        out = []
        given = zip(self.shots, evidence, colours, outlines, self.band, strict=True)
        for shot, one, colour, outline, band in given:
            near = grown(outline, 2 * band)
            covers = self.table.drawn_cover(shot) | one.mirrors
            out.append(with_colour(one.value, colour, near, covers))
        return out

    def _proven(self) -> list[Bools] | None:
        """(H, W) where each photo would show ground whose texture is proven; None: not known."""
        if self.sure is None:
            return None
        picture, ground = self.sure.astype(np.float32), self.table.ground
        return [ground.drawn(picture, shot.camera, 0.0) > 0.5 for shot in self.shots]

    def _with_contact(self, values: list[F32], foot: Bools, outlines: list[Bools]) -> list[F32]:
        """(H, W) the evidence, where the solid's foot shows at least that it is likely."""
        out = []
        for value, shot, outline in zip(values, self.shots, outlines, strict=True):
            sure = silhouette(self.cells, foot, shot) & well_inside(outline, self._edge(shot))
            out.append(np.where(sure, np.minimum(value, -CERTAIN), value))
        return out

    def _cuts(self, values: list[F32], outlines: list[Bools] | None = None) -> list[F32]:
        """(H, W) the cut of each photo; outlines: (H, W) of the solid, if there is one."""

        def one(given: tuple[F32, Shot, Bools | None]) -> F32:
            evidence, shot, outline = given
            mask = cut(evidence, shot.rgb, weight=self.weight)
            return without_false_holes(mask, shot.rgb, outline)

        known = [None] * len(values) if outlines is None else outlines
        return mapped(one, list(zip(values, self.shots, known, strict=True)), self.threads)

    def _near_outlines(self, values: list[F32], outlines: list[Bools]) -> list[F32]:
        """(H, W) masks that stay near the solid's silhouettes."""
        out = []
        for value, outline, band in zip(values, outlines, self.band, strict=True):
            distance = signed_distance(outline) / band
            doubt = self.inner * np.clip(1 - np.abs(value) / 2, 0.1, 1)
            prior = PRIOR * np.where(distance > 0, doubt, 1) * np.clip(distance, -1, 1)
            evidence = np.where(distance < -1, SURE, value - prior)
            out.append(np.asarray(evidence, np.float32))
        return self._cuts(out, outlines)

    def _free(self, masks: list[F32]) -> list[Bools]:
        """(H, W) where photos do not deny the object."""
        length = self.level.growth * self.cells.size
        return [
            grown(mask > FREE, max(1, round(pixels_of(length, shot, self.ball.center))))
            for mask, shot in zip(masks, self.shots, strict=True)
        ]

    def _covering(
        self, solid: Bools, free: list[Bools], known: list[Bools], values: list[F32]
    ) -> Bools:
        """(n ** 3,) the solid, and cells that come back, as the function of that name has it."""
        sure = _sure(values, known)
        return covering(self.cells, solid, self.shots, free, known, sure, turns=self.turns)

    def _silhouettes(self, solid: Bools) -> list[Bools]:
        return [silhouette(self.cells, solid, shot) for shot in self.shots]

    def _parts(self, images: list[F32]) -> list[F32]:
        """Images of whole photos, of any size, as the shots show them."""
        out = []
        for image, shot in zip(images, self.shots, strict=True):
            left, right, top, bottom = shot.box
            out.append(resized(image, *shot.whole)[top:bottom, left:right])
        return out

    def _parts_of(self, masks: list[Bools]) -> list[Bools]:
        return [part > 0.5 for part in self._parts([mask.astype(np.float32) for mask in masks])]

    def _reach(self, points: F64) -> float:
        """How far the plane's picture has to reach for a solid."""
        flat = points - self.ball.center
        flat -= (flat @ self.normal)[:, None] * self.normal
        along = np.linalg.norm(flat, axis=1)
        height = points @ self.normal - self.offset
        wide = WIDE * self.ball.radius
        return float(min(wide, max(NARROW * along.max(), (along + BEHIND * height).max())))

    def _placed(
        self,
        masks: list[F32],
        outlines: list[Bools],
        solid: Bools,
        room: list[Room] | None,
    ) -> Found:
        """The same for whole photos."""
        points = self.cells.points[solid]
        lines = [o.astype(np.float32) for o in outlines]
        return Found(
            [shot.placed(mask) for shot, mask in zip(self.shots, masks, strict=True)],
            [shot.placed(line) > 0.5 for shot, line in zip(self.shots, lines, strict=True)],
            room,
            self._reach(points),
            ball_of(points, self.cells.size),
            self._shadows(solid),
        )

    def _shadows(self, solid: Bools) -> list[Bools] | None:
        """(h, w) for whole photos: where the solid throws the flash's shadow on the plane."""
        if self.lamp is None:
            return None
        ground, out = self.table.ground, []
        for shot in self.shots:
            dark = shadow(self.cells, solid, shot, ground, self.lamp)
            out.append(shot.placed(dark.astype(np.float32)) > 0.5)
        return out


def _sure(values: list[F32], known: list[Bools]) -> list[Bools]:
    """(H, W) where photos are sure to show the object."""
    return [(smooth(v, 1.0) < -CERTAIN) & k for v, k in zip(values, known, strict=True)]
