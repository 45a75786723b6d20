"""Material and light, told apart by how the same places look from many sides.

The asset's own equation is fitted to what the field shows: metallic-roughness with the split sum
(`refdgs_pipe.light`), light from far away, and the object's own radiance where a mirrored ray
meets the object. docs/asset.md says what decides what.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.far_light import FarLight, ground_seen
from refdgs_pipe.ground_light import GroundLight, at_roughness
from refdgs_pipe.irradiance import Sky, links_of, look_around, spread
from refdgs_pipe.light import Environment, blur
from refdgs_pipe.texture.exposure import balanced, least_light
from refdgs_pipe.texture.false_metal import false_metal
from refdgs_pipe.texture.matrices import corner_matrix, look_matrix
from refdgs_pipe.texture.mean_light import MeanLight
from refdgs_pipe.texture.sampling import Samples
from refdgs_pipe.texture.unknowns import Batch, State, Unknown
from refdgs_pipe.texture.view_variation import ViewVariation, smooth_step

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

# Photos are exposed so that the light around is rarely darker than this on average.
_LEAST_LIGHT = 0.3
_LEAST_ROOM = 0.02  # beside a flash
# The brightest that surfaces reflect: white paint, polished silver.
_WHITE, _SILVER = 0.8, 0.9
_GUESSED = 0.2  # roughness, before any is told
_OPEN = 0.6  # what sees less of the sky says little about how bright it is
# Reflectances between which plastic turns into metal: while the light may still be too bright,
# and with the light that explains what was first told.
_FIRST, _AGAIN = (0.12, 0.24), (0.2, 0.4)
_WITH_GROUND = (0.15, 0.3)  # the same again, where a known ground tells how bright the light is
_BATCH = 50_000


@dataclass(frozen=True)
class Plan:
    """How long and how hard the fit tries.

    Args:
        epochs: times that all samples are gone through: before metal is told, before it is told
            again, before roughness is, when the light has become sharp, and after.
        rate: Adam's step.
    """

    epochs: tuple[int, int, int, int] = (20, 10, 10, 20)
    rate: float = 0.05


def fit(
    mesh: TriangleMesh,
    samples: Samples,
    light: F32,
    *,
    lift: float,
    metal: bool,
    plan: Plan | None = None,
    mean: MeanLight | None = None,
    ground: GroundLight | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Appearance:
    """The materials and the light under which the mesh looks as the field does.

    Args:
        light: (H, 2H, 3) first guess of the light, in any unit; H a multiple of 4.
        lift: how far above the surface rays start, world units.
        metal: whether there may be any.
        mean: how the light moves from photo to photo; None: it stands still.
        ground: the light below the object, if it is known; the samples have met it.
        progress: called with epochs done and in all.

    It works on one thread: torch splits its sums by the number of threads, and sixty epochs make
    roughness of the difference.
    """
    plan, before = plan or Plan(), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        problem = _Problem(mesh, samples, light, lift, mean or MeanLight(), ground)
        return _fitted(problem, plan, metal, progress)
    finally:
        torch.set_num_threads(before)


def _fitted(
    problem: "_Problem", plan: Plan, metal: bool, progress: Callable[[int, int], None]
) -> Appearance:
    total, done = sum(plan.epochs), 0
    state = problem.start(metal=metal)
    again = _AGAIN if problem.below is None else _WITH_GROUND
    telling: list[Callable[[State], State]] = [
        _kept,
        lambda state: problem.tell_metal(state, _FIRST),
        lambda state: problem.shown_by_photos(problem.tell_metal(state, again)),
        lambda state: problem.decided(
            problem.tell_roughness(problem.shown_by_photos(problem.without_false_metal(state)))
        ),
    ]
    if not metal:
        telling = [_kept, _kept, _kept, problem.tell_roughness]
    for epochs, tell in zip(plan.epochs, telling, strict=True):

        def shown(number: int, before: int = done) -> None:
            progress(before + number, total)

        state = problem.descend(tell(state), epochs, plan.rate, shown)
        done += epochs
    return problem.result(state)


def _kept(state: State) -> State:
    return state


def matte(mesh: TriangleMesh, *, lift: float) -> Appearance:
    """The materials of a field without reflections: its diffuse radiance is all there is.

    Args:
        lift: how far above the surface rays start, world units.
    """
    count = len(mesh.vertices)
    ones = np.ones(count, np.float32)
    around = _look_around(mesh, lift)
    wide = np.ones((count, 3), np.float32)
    return Appearance(mesh.vertices, ones, 0 * ones, wide, wide, wide, around.openness, None)


class _Problem:
    """The samples as matrices, cut into batches of fixed membership."""

    def __init__(
        self,
        mesh: TriangleMesh,
        samples: Samples,
        light: F32,
        lift: float,
        mean: MeanLight,
        ground: GroundLight | None,
    ) -> None:
        self.mesh, self.samples, self.mean = mesh, samples, mean
        self.guess = light if mean.white else balanced(light)
        self.ground = ground
        self.height = len(light)
        self.told, self.known = ground_seen(ground, mesh.vertices, self.height)
        self.least = least_light(ground, mesh.vertices, self.height)
        self.below: F32 | None = None
        if samples.ground is not None:
            beside = FarLight(self.told, self.known)
            self.below = beside.levels(samples.ground, samples.mirrored)
        self.blur = blur(self.height)
        self.links = links_of(mesh.faces)
        self.sky: Sky = _look_around(mesh, lift)
        self.corners = corner_matrix(mesh, samples.face, samples.weights)
        near = samples.near_face >= 0
        self.far = ~near
        self.sent = self._filled(samples.radiance)
        met = corner_matrix(mesh, np.maximum(samples.near_face, 0), samples.near_weights)
        self.near = np.where(near[:, None], met @ self.sent, 0).astype(np.float32)
        self.looks = [look_matrix(samples.mirrored, rows) for rows in self.blur.heights[:-1]]
        order = np.random.default_rng(0).permutation(len(samples.face))
        parts = np.array_split(order, max(1, round(len(order) / _BATCH)))
        self.rows = [np.sort(part) for part in parts]
        self.batches = [
            Batch.of(
                samples,
                self.near,
                self.corners,
                self.looks,
                rows,
                flash=mean.lighting.flash,
                below=self.below,
            )
            for rows in self.rows
        ]

    def _filled(self, values: F32) -> F32:
        """(V, C) mean of samples at each vertex; where there is none, what spreads to it."""
        weight = np.asarray(self.corners.sum(0)).reshape(-1, 1)
        mean = np.asarray(self.corners.T @ values, np.float32) / np.maximum(weight, 1e-6)
        known = (weight > 1e-3).astype(np.float32)
        mean *= known
        for _ in range(60):
            if known.all():
                break
            wider, share = spread(mean, self.links), spread(known, self.links)
            fresh = (known == 0) & (share > 0)
            mean = np.where(fresh, wider / np.maximum(share, 1e-9), mean)
            known = np.where(fresh, 1, known).astype(np.float32)
        return np.asarray(mean, np.float32)

    def start(self, *, metal: bool) -> State:
        """A first guess: the light's unit from what is brightest, metal from what mirrors most."""
        count = len(self.mesh.vertices)
        guess = Environment(self.guess)
        rough = np.full(len(self.far), _GUESSED, np.float32)
        mirrored = guess.mirrored(self.samples.mirrored, rough)
        sky = self.far[:, None] & (self.samples.of_ground(rough)[:, 3:] < 0.5)
        given, had = (self._filled(np.where(sky, v, 0)) for v in (self.samples.specular, mirrored))
        share = given.mean(1) / np.maximum(had.mean(1), 1e-4)
        unit = max(
            self._white_unit(),
            _heavy_median(share, given.mean(1)) / _SILVER if metal else 0.0,
            (_LEAST_ROOM if self.mean.white else _LEAST_LIGHT)
            / max(float(self.guess.mean()), 1e-6),
        )
        seen = np.where(self.far[:, None], self.samples.specular, 0)
        met = np.float32(unit) * mirrored * self.far[:, None]
        if self.below is not None:
            rest = Environment(np.float32(unit) * self._beyond(self.guess))
            beyond = rest.mirrored(self.samples.mirrored, rough)
            met = (at_roughness(self.below, rough) + beyond) * self.far[:, None]
        given, had = (self._filled(np.asarray(v, np.float32)) for v in (seen, met))
        share = given.mean(1) / np.maximum(had.mean(1), 1e-4)
        metallic = np.clip((share - 0.06) / 0.5, 0.05, 0.9) if metal else np.zeros(count)
        light = np.maximum(self.guess.reshape(-1, 3) * np.float32(unit), 0.01)
        state = State(
            np.where(self.known[:, None], np.maximum(self.told, 1e-4), light),
            np.full(count, 0.3, np.float32),
            metallic.astype(np.float32),
            np.full((count, 3), 0.8, np.float32),
            np.ones((count, 3), np.float32),
            np.ones((count, 3), np.float32),
            known=self.known if self.known.any() else None,
        )
        return self._lit(state)

    def _white_unit(self) -> float:
        """The factor of the guess under which hardly any diffuse colour is brighter than white."""
        if self.mean.white:  # what a flash sheds is known
            return 0.0
        diffuse = self._filled(self.samples.diffuse).mean(1)
        nothing = np.zeros_like(self.sent)
        known = self.known.reshape(self.height, -1, 1)
        told = (known * self.told.reshape(self.guess.shape)).astype(np.float32)
        far = self.mean.received(self._beyond(self.guess), self.sky, nothing).mean(1)
        near = self.mean.received(told, self.sky, self.sent).mean(1)
        seen = (np.asarray(self.corners.sum(0)).reshape(-1) > 1) & (self.sky.openness > _OPEN)
        if not seen.any():
            return 0.0
        needed = (diffuse / _WHITE - near) / np.maximum(far, 1e-4)
        return float(np.quantile(needed[seen], 0.95))

    def _lit(self, state: State) -> State:
        """The state with the light that reaches each vertex brought up to date."""
        around = state.light.reshape(self.height, -1, 3)
        received = self.mean.received(around, self.sky, self.sent)
        return replace(state, received=np.maximum(received, 1e-3))

    def tell_metal(self, state: State, between: tuple[float, float]) -> State:
        """Estimate metal from how much reflections vary from view to view.

        Args:
            between: what reflects no more than the first is no metal, no less than the second is.
        """
        rest, variation = self._variation(state)
        plastic, metal = between
        found = variation.reflectance(rest, state.roughness)
        metallic = smooth_step(found, plastic, metal)
        return self.tell_tint(replace(state, metallic=metallic, told_metallic=metallic))

    def tell_tint(self, state: State) -> State:
        """Estimate the colour of metals, and with it how bright the far light is.

        Both are left as they are if the ground's light is not known.
        """
        if self.below is None:
            return self._lit(state)
        rest, variation = self._variation(state)
        metal = state.metallic > 0.5
        unit, tint = variation.tint(rest, state.roughness, metal)
        bright = np.where(self.known, 1, unit)[:, None]
        told = np.where(metal[:, None], tint, state.tint).astype(np.float32)
        light = (state.light * bright).astype(np.float32)
        return self._lit(replace(state, light=light, tint=told, told_tint=told))

    def shown_by_photos(self, state: State) -> State:
        """Metals shall look as in the photos from now on, which are sharper than the field.

        What is no metal keeps the field's colours, whose split is known.
        """
        if self.samples.glint is not None:  # they show what the field does already
            return state
        metal = np.asarray(self.corners @ state.metallic, np.float32)[:, None] > 0.5
        wanted = np.where(metal, self.samples.photo, self.samples.radiance)
        pairs = zip(self.rows, self.batches, strict=True)
        self.batches = [batch.showing(wanted[rows]) for rows, batch in pairs]
        return state

    def without_false_metal(self, state: State) -> State:
        """Metal stays unless one colour a place explains what the views show much better."""
        metal = state.metallic > 0.5
        missed, varied = self._unexplained(replace(state, metallic=metal.astype(np.float32)))
        false = false_metal(metal, missed, varied, self.sent, self.links)
        metallic = np.where(false, 0, state.metallic).astype(np.float32)
        return self._lit(replace(state, metallic=metallic, told_metallic=metallic))

    def decided(self, state: State) -> State:
        """Every part of one colour is metal, or none of it is."""
        rest, variation = self._variation(state)
        metal = variation.metal_parts(rest, state.roughness, state.metallic, self.sent)
        return self.tell_tint(replace(state, metallic=metal, told_metallic=metal))

    def _unexplained(self, state: State) -> tuple[F32, F32]:
        """(V,) squared sRGB differences around each vertex, from the fit and from its mean.

        Where the mesh mirrors itself, what it mirrors is known roughly. It does not count.
        """
        missed, colours = np.zeros((len(self.far), 1)), np.zeros((len(self.far), 3))
        counted = self.far[:, None].astype(np.float64)
        unknown = Unknown(state, balanced=self.below is not None)
        with torch.no_grad():
            for rows, batch in zip(self.rows, self.batches, strict=True):
                colours[rows] = batch.target
                apart = batch.shown(unknown, self.blur) - batch.target
                missed[rows] = (apart**2).mean(1, keepdim=True)
        back = self.corners.T
        count = np.maximum(back @ counted, 1e-6)
        varied = back @ (counted * colours**2) - (back @ (counted * colours)) ** 2 / count
        return (back @ (counted * missed))[:, 0], np.maximum(varied, 0).mean(1)

    def tell_roughness(self, state: State) -> State:
        """Estimate roughness from how much reflections vary from view to view.

        A metal's reflectance is not known beforehand. But least squares only ever takes it for too
        rough, so there the smoother of both counts.
        """
        if self.samples.glint is not None:  # the width of the lamp's highlights tells it
            return self._lit(state)
        light, variation = self._variation(state)
        found = variation.roughness(light, state.metallic, state.tint)
        smoother = np.minimum(state.roughness, found)
        roughness = np.asarray(found + state.metallic * (smoother - found), np.float32)
        return self.tell_tint(replace(state, roughness=roughness, told_roughness=roughness))

    def _variation(self, state: State) -> tuple[Environment, ViewVariation]:
        light = Environment(self._beyond(state.light.reshape(self.height, -1, 3)))
        shown = ViewVariation(self.samples, self.corners, self.near, self.links, self.below)
        return light, shown

    def _beyond(self, light: F32) -> F32:
        """(H, 2H, 3) light without that of the ground, which `below` has."""
        known = self.known.reshape(self.height, -1, 1)
        return np.asarray(np.where(known, 0, light), np.float32)

    def descend(
        self, state: State, epochs: int, rate: float, progress: Callable[[int], None]
    ) -> State:
        """Adam on all unknowns, batch by batch."""
        # not before metal is told: brighter light hides it, because mirrors show lamps clipped
        last = state.told_roughness is not None
        least = self.least if last else None
        unknown = Unknown(state, balanced=self.below is not None, least=least)
        optimizer = torch.optim.Adam(unknown.groups(rate, metal=not last))
        links = torch.from_numpy(self.links)
        for epoch in range(epochs):
            progress(epoch)
            for batch in self.batches:
                optimizer.zero_grad(set_to_none=True)
                loss = ((batch.shown(unknown, self.blur) - batch.target) ** 2).mean()
                (loss + unknown.roughening(links, self.height)).backward()  # type: ignore[no-untyped-call]
                optimizer.step()
        return self._lit(unknown.state())

    def result(self, state: State) -> Appearance:
        """What was found, as it is kept."""
        return Appearance(
            points=self.mesh.vertices,
            roughness=state.roughness,
            metallic=state.metallic,
            tint=state.tint,
            gain=state.gain,
            received=state.received,
            openness=self.sky.openness,
            environment=state.light.reshape(self.height, -1, 3),
            lighting=self.mean.lighting,
            white=self.mean.white,
            ground=self.ground,
        )


def _look_around(mesh: TriangleMesh, lift: float) -> Sky:
    return look_around(mesh.vertices, mesh.faces, mesh.vertex_normals(), lift=lift)


def _heavy_median(values: F32, weights: F32) -> float:
    """The value below which half of the weight lies."""
    order = values.argsort()
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
