"""Metal and roughness, estimated from how much a place's reflections vary from view to view.

A surface sends light * reflectance, so that over the views of one place the deviation of what it
mirrors is that of the light it mirrors, blurred, times its reflectance. This asks for no correct
normal: a wrong one mirrors other light, but light that varies as much. Least squares would take
every misplaced reflection for a rougher surface.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.ground_light import at_roughness
from refdgs_pipe.irradiance import spread
from refdgs_pipe.light import DIELECTRIC, Environment, reflected_share, reflection_line
from refdgs_pipe.texture.evening import evened
from refdgs_pipe.texture.metal_tint import Mirrored, even_tint
from refdgs_pipe.texture.one_colour import mean_over_parts, parts_of_one_colour
from refdgs_pipe.texture.part_metal import Lines
from refdgs_pipe.texture.sampling import Samples, seen_roughness

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_FAINT = 0.06  # light that varies less than this, linear, tells little about what mirrors it
_SMOOTHING = 4  # rounds, for metal
_BORDER = 2  # edges over which metal ends at last
# Where the ground is mirrored:
_TYPICAL = 0.25  # roughness at which seen and known light are compared
_MOSTLY = 0.5  # share of the ground in what a sample mirrors, from which the sample counts
_ENOUGH = 0.5  # such samples at a vertex
_PLAIN = 0.004  # linear: ground that varies less tells nothing of how alike both vary
_INEXACT = 1.3  # factor: the mirrored place is known roughly, so both vary less alike than they are
_RATHER = 0.5  # weight of that estimate against the other, where only the ground is mirrored
_UNSURE = 1.5  # factor of the largest possible reflectance under far light, whose unit is unknown
# Evening between neighbours:
_EVEN = 0.12  # range, in edges, for each square root of the number of vertices
_LITTLE, _LEAST_EVIDENCE = 0.03, 0.01  # light that varies so much, linear, tells half; the least
# Roughness:
_WIDELY = 16  # rounds, for roughness: places that mirror little contrast ask those that mirror more
_UNTOLD = 0.05  # a deviation this much smaller, in logarithms, counts as that of the sharpest
_ASSUMED = 0.02  # how much glossy counts beside what like places tell
_TELLING = 0.04  # so large a difference, in logarithms, tells as much as what is assumed
_IS_NOISE, _IS_SEEN = 0.2, 0.5  # the field's deviation, as shares of the photos'
_GRID = (0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0)
_GLOSSY = 2  # of the grid: what polished and glazed things have, assumed where nothing tells
_REFLECTANCES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4)


@dataclass(frozen=True)
class ViewVariation:
    """Deviations over the samples (N) around each vertex (V) of a mesh.

    Args:
        samples: what the views show.
        corners: sparse (N, V), from vertices to samples.
        near: (N, 3) radiance that mirrored rays meet on the mesh.
        links: (E, 2) neighbouring vertices.
        below: (N, K, 3) of `FarLight.levels`; None where the ground's light is not known. With
            it, the light that is asked about is that of the rest.
    """

    samples: Samples
    corners: Any
    near: F32
    links: Ints
    below: F32 | None = None

    def reflectance(self, light: Environment, roughness: F32) -> F32:
        """(V,) the reflectance with which a vertex's reflections vary as they are seen to do.

        Compared as photos show them, clipped at white: what is brighter varies without limit in the
        light that was found, but not in what was seen. If the ground's light is known, photos are
        asked as well; it counts how far both vary alike where a vertex mirrors the ground; no place
        sends more than its reflectance times its light; and neighbours that look alike get like
        values.

        Args:
            roughness: (V,) as far as it is known.
        """
        samples = self.samples
        mirrored = self._mirrored(light, np.asarray(self.corners @ roughness, np.float32))
        around = self._around(np.ones(len(mirrored), np.bool_), _SMOOTHING)
        seen = around.deviation(np.clip(samples.specular, 0, 1))
        if samples.ground is not None:
            seen = np.maximum(seen, self._varied_in_photos(around))
        seen = np.maximum(seen, 1e-5)
        excess = np.empty((len(_REFLECTANCES), len(seen)), np.float32)
        for i, value in enumerate(_REFLECTANCES):
            shown = around.deviation(np.clip(np.float32(value) * mirrored, 0, 1))
            excess[i] = np.log(seen / np.hypot(shown, np.float32(value * _FAINT)))
        found = _crossing(np.asarray(_REFLECTANCES, np.float32), excess)
        if samples.ground is None:  # measured: what follows harms there (ground-light.md)
            return found
        alike, told = self._like_ground(light)
        known = around.mean(self._share_of_ground()[:, None])[:, 0]
        found = alike + (1 - _RATHER * told * known**2) * np.maximum(found - alike, 0)
        met = np.clip(mirrored, 0, 1)
        sent, had = (around.mean(v) for v in (np.clip(samples.photo, 0, 1), met))
        most = (sent / np.maximum(had, 1e-4)).max(1) * (_UNSURE + (1 - _UNSURE) * known)
        varied = around.deviation(met) ** 2
        evidence = varied / (varied + np.float32(_LITTLE**2)) + np.float32(_LEAST_EVIDENCE)
        found = evened(np.minimum(found, most), evidence, sent, self.links, _EVEN)
        return np.asarray(np.minimum(found, most), np.float32)

    def _varied_in_photos(self, around: "_Around") -> F32:
        """(V,) how much what is mirrored varies at least, as photos show it.

        The field paints the reflections of a small part on surfels behind its surface, as colours
        that do not vary. The photos show that they do: in one view, neighbours are brighter
        together. A fine print varies there as well, seen through a wrong mesh, but each place
        differently.
        """
        shown = np.clip(self.samples.photo, 0, 1)
        return np.sqrt(around.between(shown, self.samples.view))

    def tint(
        self, rest: Environment, roughness: F32, metal: NDArray[np.bool_]
    ) -> tuple[float, F32]:
        """`even_tint` of the mesh; the ground's light must be known.

        Args:
            rest: light without that of the ground.
            roughness: (V,) as far as it is known; metal: (V,).
        """
        samples = self.samples
        assert self.below is not None and samples.ground is not None
        of_metal = np.asarray(self.corners @ metal.astype(np.float32)) > 0.5
        rows = np.flatnonzero((samples.near_face < 0) & of_metal)
        rough = np.asarray(self.corners[rows] @ roughness, np.float32)
        seen = np.asarray(seen_roughness(rough, samples.footprint[rows]), np.float32)
        mirrored = Mirrored(
            samples.photo[rows],
            at_roughness(self.below[rows], seen),
            rest.mirrored(samples.mirrored[rows], seen),
            at_roughness(samples.ground[rows], seen)[:, 3:],
            *reflection_line(rough[:, None], np.clip(samples.cosine[rows, None], 0.02, 1)),
            self.corners[rows],
        )
        wide = self._around(np.ones(len(samples.face), np.bool_), _SMOOTHING)
        return even_tint(mirrored, metal, wide.mean(samples.photo), self.links)

    def metal_parts(self, light: Environment, roughness: F32, metallic: F32, colors: F32) -> F32:
        """(V,) the share of metal: each part of one colour is metal or not, with soft borders.

        Most of a part decides. Where the ground's light is known, and so how bright the light is,
        the part's line in the light can overrule it.

        Args:
            roughness, metallic: (V,) as far as they are known.
            colors: (V, 3) linear, what is seen of each vertex in the mean.
        """
        part = parts_of_one_colour(colors, self.links)
        count = np.asarray(self.corners.sum(0)).reshape(-1) + 1e-3  # parts without samples, too
        metal = mean_over_parts(metallic, count, part) > 0.5
        if self.below is not None:
            mirrored = self._mirrored(light, np.asarray(self.corners @ roughness, np.float32))
            seen, met = (np.clip(v, 0, 1) for v in (self.samples.photo, mirrored))
            lines = Lines.of(part, self.corners, seen, met, self.samples.near_face < 0)
            metal = lines.metal(metal)
        share = metal[part, None].astype(np.float32)
        for _ in range(_BORDER):
            share = spread(share, self.links)
        return share[:, 0]

    def _like_ground(self, light: Environment) -> tuple[F32, NDArray[np.bool_]]:
        """(V,) the reflectance with which a vertex mirrors the ground, and (V,) where it is told.

        The geometric mean of two estimates: least squares takes noise in the light for a lower
        reflectance, and the ratio of the deviations takes noise in what is seen for a higher one.
        0 where it is not told.
        """
        around = self._around(self._meets_ground(), _SMOOTHING)
        rough = np.full(len(self.samples.face), _TYPICAL, np.float32)
        mirrored = np.clip(self._mirrored(light, rough), 0, 1)
        both, had, seen = around.together(mirrored, np.clip(self.samples.specular, 0, 1))
        told = (around.count() >= _ENOUGH) & (had > _PLAIN**2)
        had = np.maximum(had, 1e-8)
        alike = np.sqrt(np.maximum(both, 0) / had * np.sqrt(seen / had))
        return np.where(told, _INEXACT * alike, 0).astype(np.float32), told

    def _share_of_ground(self) -> F32:
        """(N,) the ground's share in what a sample mirrors."""
        return self.samples.of_ground(np.full(len(self.samples.face), _TYPICAL, np.float32))[:, 3]

    def _meets_ground(self) -> NDArray[np.bool_]:
        """(N,) the samples that mirror it for the most part; rays that meet the mesh have none."""
        return np.asarray(self._share_of_ground() > _MOSTLY)

    def roughness(self, light: Environment, metallic: F32, tint: F32) -> F32:
        """(V,) the roughness with which a vertex's reflections vary as they are seen to do.

        Photos are asked, which are sharper than the field: what they show more than its diffuse
        radiance. Where they vary several times as much as it does, that is a texture seen through
        a wrong mesh, and the field is asked. All that a metal sends is mirrored. Where roughness
        hardly changes what is shown, or nothing is mirrored from afar, neighbours that look alike
        tell it if the ground is known; where nothing tells it, glossy is assumed.

        Args:
            metallic: (V,) as told; tint: (V, 3) linear reflectance of what is metal.
        """
        metal = metallic[:, None]
        f0 = np.asarray(self.corners @ (DIELECTRIC * (1 - metal) + tint * metal), np.float32)
        cosine = np.clip(self.samples.cosine, 0.02, 1)[:, None]
        around = self._around(self.samples.near_face < 0, _WIDELY)
        seen = self._seen(around, metallic)
        excess = np.empty((len(_GRID), len(seen)), np.float32)
        for i, value in enumerate(_GRID):
            rough = np.full(len(cosine), value, np.float32)
            share = reflected_share(f0, rough[:, None], cosine)
            mirrored = np.clip(self._mirrored(light, rough) * share, 0, 1)
            shown = around.deviation(mirrored)
            excess[i] = np.log(np.maximum(shown, 1e-6) / seen)
        shows, short = excess[0] - excess[_GLOSSY], np.maximum(excess[0], 0)
        enough = np.minimum(around.count(), 1)
        evidence = enough * (shows**2 + short**2)
        excess -= _UNTOLD * np.clip(2 - excess[0] / _UNTOLD, 0, 1)
        found = _crossing(np.asarray(_GRID, np.float32), excess)
        trust = evidence / (evidence + _TELLING**2)
        if self.samples.ground is None:
            return np.asarray(_GRID[_GLOSSY] + trust * (found - _GRID[_GLOSSY]), np.float32)
        wide = self._around(np.ones(len(cosine), np.bool_), _SMOOTHING)
        weight = trust + _ASSUMED
        value = (trust * found + _ASSUMED * _GRID[_GLOSSY]) / weight
        sent = wide.mean(np.clip(self.samples.photo, 0, 1))
        return evened(value, weight, sent, self.links, _EVEN)

    def _seen(self, around: "_Around", metallic: F32) -> F32:
        """(V,) how much what is mirrored varies, as the field and the photos show it."""
        beyond = np.clip(self.samples.photo - self.samples.diffuse, 0, 1)
        field = np.maximum(around.deviation(np.clip(self.samples.specular, 0, 1)), 1e-5)
        photo = np.maximum(around.deviation(beyond), 1e-5)
        share = np.asarray(field / photo, np.float32)
        trust = np.maximum(smooth_step(share, _IS_NOISE, _IS_SEEN), metallic)
        return np.asarray(field * (photo / field) ** trust, np.float32)

    def _mirrored(self, light: Environment, rough: F32) -> F32:
        seen = seen_roughness(rough, self.samples.footprint)
        far = light.mirrored(self.samples.mirrored, seen)
        if self.below is not None:
            far = far + at_roughness(self.below, seen)
        return np.where(self.samples.near_face[:, None] < 0, far, self.near)

    def _around(self, counted: NDArray[np.bool_], rounds: int) -> "_Around":
        return _Around(self.corners, self.links, counted[:, None].astype(np.float32), rounds)


_ONE = np.ones((1, 1), np.float32)


@dataclass(frozen=True)
class _Around:
    """The samples (N, 1) that count around each vertex, and those of some rounds of neighbours."""

    corners: Any
    links: Ints
    counted: F32
    rounds: int

    def count(self) -> F32:
        """(V,) how many there are at a vertex, on average over the neighbours."""
        return self._widely(self._summed(_ONE))[:, 0]

    def deviation(self, values: F32) -> F32:
        """(V,) standard deviation of values (N, C) over the samples at one vertex.

        Variances are averaged over the neighbours, so that what varies most counts most.
        """
        weight, first, second = (self._summed(v) for v in (_ONE, values, values * values))
        variance = np.maximum(second - first * first / np.maximum(weight, 1e-6), 0)
        both = self._widely(np.concatenate([variance.mean(1, keepdims=True), weight], 1))
        return np.asarray(np.sqrt(both[:, 0] / np.maximum(both[:, 1], 1e-6)), np.float32)

    def mean(self, values: F32) -> F32:
        """(V, C) of values (N, C) over the samples of a vertex and of its neighbours."""
        total = np.concatenate([self._summed(values), self._summed(_ONE)], 1)
        wide = self._widely(total)
        return np.asarray(wide[:, :-1] / np.maximum(wide[:, -1:], 1e-6), np.float32)

    def between(self, values: F32, groups: Ints) -> F32:
        """(V,) variance between groups of samples (N, C): of the means of the groups at a vertex.

        Each mean is taken of the differences from the mean of all groups, over the neighbours too.

        Args:
            groups: (N,) the number of each sample's group.
        """
        weight = self._summed(_ONE)
        mean = self._summed(values) / np.maximum(weight, 1e-6)
        apart = values - self.corners @ mean
        order = np.argsort(groups, kind="stable")
        varied, share = np.zeros(len(mean)), np.zeros(len(mean))
        for rows in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1):
            back, counted = self.corners[rows].T, self.counted[rows]
            sums = np.concatenate([back @ (counted * apart[rows]), back @ counted], 1)
            wide = self._widely(sums)
            added = wide[:, :-1] / np.maximum(wide[:, -1:], 1e-6)
            varied += wide[:, -1] * (added**2).mean(1)
            share += wide[:, -1]
        return np.asarray(varied / np.maximum(share, 1e-6), np.float32)

    def together(self, one: F32, other: F32) -> tuple[F32, F32, F32]:
        """(V,) covariance and the two variances of values (N, C) over the samples at one vertex.

        Averaged over the neighbours, as `deviation` is.
        """
        weight, a, b = (self._summed(v) for v in (_ONE, one, other))
        products = [(one * other, a * b), (one * one, a * a), (other * other, b * b)]
        sums = [
            (self._summed(product) - mean / np.maximum(weight, 1e-6)).mean(1, keepdims=True)
            for product, mean in products
        ]
        wide = self._widely(np.concatenate([*sums, weight], 1)).T
        both, first, second = wide[:3] / np.maximum(wide[3], 1e-6)
        return both, np.maximum(first, 0), np.maximum(second, 0)

    def _summed(self, values: F32) -> F32:
        return np.asarray(self.corners.T @ (self.counted * values), np.float32)

    def _widely(self, values: F32) -> F32:
        values = values.astype(np.float32)
        for _ in range(self.rounds):
            values = spread(values, self.links)
        return values


def smooth_step(values: F32, low: float, high: float) -> F32:
    """0 up to `low`, 1 from `high` on, smooth between."""
    step = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(step * step * (3 - 2 * step), np.float32)


def _crossing(grid: F32, excess: F32) -> F32:
    """(V,) where falling rows (G, V) over a grid (G,) cross zero, or the end that is nearer."""
    above = np.clip((excess > 0).sum(0), 1, len(grid) - 1)
    column = np.arange(excess.shape[1])
    high, low = excess[above - 1, column], excess[above, column]
    part = np.clip(high / np.maximum(high - low, 1e-6), 0, 1)
    return np.asarray(grid[above - 1] + part * (grid[above] - grid[above - 1]), np.float32)
