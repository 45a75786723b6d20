"""Where on the plane the object stands for sure, before its masks are known."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools, whole_shots
from refdgs_pipe.masking.gloss import is_glossy
from refdgs_pipe.masking.levels import LEVELS
from refdgs_pipe.masking.plain import plain_bodies
from refdgs_pipe.masking.repeating import covered, lattice
from refdgs_pipe.masking.table import TOLERANCES, Table
from refdgs_pipe.masking.unproven import proven, shown_from, unproven, without_ground
from refdgs_pipe.masking.walls import Wall, footprint, mirror_walls

WIDE = 2.2  # radii of the ball that the plane's picture reaches at first


@dataclass(frozen=True, eq=False)
class Foot:
    """Where the object stands.

    Args:
        walls: the flat mirrors that stand on the plane.
        covered: (n, n) of a picture of the plane, where evidence for it does not count: its pattern
            does not go on, or a plain body stands; None where nothing is known of that.
        radius: how far that picture reaches, world units.
        hangs: (n, n) of it, where photos agree on a plain body that hangs over the plane; or None.
        proven: (n, n) of it, where photos from several sides agree on the plane's texture; None
            where that was not asked: on a ground that repeats, and under a flash.
        unproven: (n, n) of it, where something hides the plane and no texture proves it; None
            where that was not asked, or is nowhere. What hides it stands there, or is above it.
    """

    walls: list[Wall]
    covered: Bools | None = None
    radius: float = 0.0
    hangs: Bools | None = None
    proven: Bools | None = None
    unproven: Bools | None = None

    def on_unproven(self) -> "Foot":
        """The same, if the object stands wherever nothing proves that photos see the plane."""
        if self.unproven is None:
            return self
        there = self.unproven if self.covered is None else self.covered | self.unproven
        return replace(self, covered=there, unproven=None)

    def on(self, ground: Ground, n: int) -> Bools:
        """(n, n) the covered cells of another picture of the plane, with the same middle."""
        return footprint(self.walls, ground, n) | self._drawn(self.covered, ground, n)

    def below(self, ground: Ground, n: int) -> Bools:
        """(n, n) the same of the cells that a plain body hangs over."""
        return self._drawn(self.hangs, ground, n)

    def sure(self, ground: Ground, n: int) -> Bools | None:
        """(n, n) the same of the cells whose texture is proven."""
        return None if self.proven is None else self._drawn(self.proven, ground, n)

    def _drawn(self, cells: Bools | None, ground: Ground, n: int) -> Bools:
        if cells is None:
            return np.zeros((n, n), bool)
        place = ((np.arange(n) + 0.5) / n * 2 - 1) * ground.radius / self.radius
        at = ((place + 1) / 2 * len(cells) - 0.5).astype(np.float32)
        x, y = np.meshgrid(at, at)
        found = cv2.remap(cells.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0)
        return np.asarray(found > 0.5)


def foot(
    views: Views,
    model: SparseModel,
    plane: tuple[F64, float],
    threads: int,
    *,
    light: Lighting | None = None,
) -> Foot:
    """Where the object stands, as far as the plane's picture alone can tell.

    A ground that repeats tells it by its pattern. On another one, flat mirrors, plain bodies and
    places without proof of the plane tell it.

    Args:
        plane: unit normal and offset, world.
        light: a flash, whose shadows move with the camera, or a turntable, on which reflections
            move; None for a still light.
    """
    level, ball = LEVELS[-1], model.ball
    shots = list(whole_shots(views, model, level.side))
    ground = Ground.under(ball, *plane, WIDE * ball.radius)
    table = Table(ground, level.cells, len(shots), threads).found(shots)
    seen = table.seen(shots, None)
    pattern = lattice(table.colour.mean(-1), table.share)
    if pattern is None:
        centers = np.stack([shot.camera.center for shot in shots])
        given = (table.colour, seen, ground, centers, ball.radius)
        there, hangs = plain_bodies(*given)
        sure = doubtful = None
        if light is None or light.lamp is None:  # in a shadow, the plane does not look like itself
            towards = shown_from(table.colour, seen, ground, centers)
            sure = proven(towards)
            there = without_ground(there, sure)
            doubtful = unproven(*given, towards) & ~there
            wider = unproven(*given, towards, glossy=True) & ~there
            still = light is None or light.kind == "world"
            if still and (wider & ~doubtful).any():  # it matters whether the ground is glossy
                glossy = is_glossy(shots, ball, plane, ground.radius, threads)
                doubtful = wider if glossy else doubtful
        walls = mirror_walls(table, seen, centers, ball.radius)
        stands, unsure = (None if a is None or not a.any() else a for a in (there, doubtful))
        return Foot(walls, stands, ground.radius, hangs, sure, unsure)
    return Foot([], covered(table.colour, _agreeing(table, seen), pattern), ground.radius)


def _agreeing(table: Table, seen: F32) -> F32:
    """(n, n) share of all photos that show the plane's colour; those that show none count too."""
    near = np.abs(seen - table.colour).max(-1) < TOLERANCES[-1]
    return np.asarray(near.mean(0), np.float32)
