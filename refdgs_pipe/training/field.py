"""The field being trained: its sets, its shader, how they step, grow and are saved."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import RawSet, Start
from refdgs_pipe.artifacts.surfel_field import ShaderModel, SurfelField, SurfelSet
from refdgs_pipe.ops import Pinhole, observe
from refdgs_pipe.ops.cuda import sent
from refdgs_pipe.training.exposure import Exposures
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.hollow import Hollow
from refdgs_pipe.training.moving_light import moving
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.poses import Poses
from refdgs_pipe.training.reflection import Shader
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.shading import Picture, Scene, sh_color
from refdgs_pipe.training.starting import BALL_MARGIN
from refdgs_pipe.training.surfels import (
    DensityRules,
    TrainableSet,
    all_optimizers,
    array,
    densify,
    step_all,
)

FAINT = 0.05  # what starts as faint as 0.1 is pruned below this at most
POSES_FROM = 0.1  # fraction of the run after which poses are refined
LARGEST = 0.1  # surfels larger than this share of the extent go


class TrainableField:
    """Geometry, local reflection and background surfels, and the shader.

    Args:
        start: the surfels to begin with.
        photos: on the CPU; they are looked at only here. Masks, also those that a first look found,
            say how large the object is.
        masked: the photos' background is removed, and needs no surfels.
        device: where the surfels and the shader are.
        refined: the photos' poses are corrected.
        lighting: how the light moves; None: it stands still.
    """

    def __init__(
        self,
        params: TrainParams,
        model: SparseModel,
        start: Start,
        photos: list[TrainingPhoto],
        *,
        masked: bool,
        near: float,
        device: str = "cpu",
        refined: bool = False,
        lighting: Lighting | None = None,
    ) -> None:
        self.params, self.near, self.device = params, near, device
        self.light = moving(lighting, device)
        self.light_optimizer = [] if self.light is None else [self.light.optimizer()]
        self.around = Surroundings(model, ground=start.ground == "background" and not masked)
        vessel = start.vessel
        self.hollow = None if vessel is None else Hollow(vessel, start.ball, device)
        # Without masks nothing but reflections holds a mirror's surface in place from the start.
        self.reflect_from = params.reflect_from if masked else 0.0
        cameras = [photo.camera for photo in photos]
        centers = np.stack([camera.center for camera in cameras])
        self.extent = 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
        if len(cameras) == 1 or self.extent <= 0:
            self.extent = float(np.linalg.norm(centers[0] - model.ball.center))
        most = params.surfels_per_pixel * _covered_pixels(model, photos)
        self.most = max(start.surfels, min(params.max_surfels, round(most)))
        fewest = len(start.local["means"])
        self.most_local = max(fewest, min(params.max_local_surfels, round(most / 2)))
        self.most_behind = start.background_surfels
        self.rates = self._rates()
        self.faintest = min(params.prune_opacity, FAINT) if start.faint else params.prune_opacity
        self.geometry = self._set(self._colored(start.geometry))
        self.local: TrainableSet | None = None
        self.shader: Shader | None = None
        self.shader_optimizer: list[torch.optim.Adam] = []
        self.random = torch.from_numpy(start.random)  # torch's generator when the field is made
        if params.reflection:
            self._with_reflections(start)
        self.background: TrainableSet | None = None
        self.exposures: Exposures | None = None
        if not masked and params.exposure == "fitted":
            self.exposures = Exposures(len(photos), params.rate_exposure, device)
        self.poses = Poses(cameras, model.ball, params.rate_poses) if refined else None
        if start.background is not None:
            self.background = self._set(_tensors(start.background))

    def _colored(self, start: RawSet) -> dict[str, Tensor]:
        """The geometry with all that it carries."""
        p, raw, n = self.params, _tensors(start), len(start["means"])
        if "raw_diffuse" not in raw:
            raw["raw_diffuse"] = torch.full((n, 3), -p.diffuse_bias if p.reflection else 0.0)
        raw["raw_roughness"] = torch.zeros(n)
        if p.reflection and p.local == "shared":
            raw["features"] = torch.zeros(n, 4)
        return raw

    def _with_reflections(self, start: Start) -> None:
        """The shader, and local surfels throughout the ball."""
        p = self.params
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self.random)
            shader = Shader(
                p.environment_height,
                p.local,
                p.mixing,
                p.physical,
                half=start.bfloat16,
                flash=self.light is not None and self.light.lighting.kind == "flash",
            )
            self.random = torch.get_rng_state()
        self.shader = shader.to(self.device)
        groups = [
            {"params": self.shader.maps(), "lr": p.rate_environment},
            {"params": [*self.shader.weights, *self.shader.biases], "lr": p.rate_shader},
        ]
        self.shader_optimizer = [torch.optim.Adam(groups, eps=1e-15, fused=True)]
        if p.local == "dual":
            raw = _tensors(start.local)
            raw["features"] = torch.zeros(len(raw["means"]), 4)
            self.local = self._set(raw)

    def _set(self, raw: dict[str, Tensor]) -> TrainableSet:
        return TrainableSet({k: v.to(self.device) for k, v in raw.items()}, self.rates)

    def _rates(self) -> dict[str, float]:
        p = self.params
        return {
            "means": p.rate_means * self.extent,
            "quats": p.rate_quats,
            "log_scales": p.rate_scales,
            "raw_opacities": p.rate_opacities,
            "raw_diffuse": p.rate_diffuse,
            "raw_roughness": p.rate_roughness,
            "features": p.rate_features,
            "sh": 0.002,
        }

    def set_rates(self, fraction: float) -> None:
        """Centres slow down log-linearly to 1/100 over the run, all else at its end."""
        p = self.params
        late = max(0.0, fraction - p.anneal_from) / max(1 - p.anneal_from, 1e-6)
        share = p.anneal_to**late
        for group in self._sets():
            for name in group.raw:
                group.set_rate(name, self.rates[name] * share)
            group.set_rate("means", self.rates["means"] * 0.01**fraction)
        if self.shader_optimizer:
            rates = (p.rate_environment, p.rate_shader)
            groups = self.shader_optimizer[0].param_groups
            for parameters, rate in zip(groups, rates, strict=True):
                parameters["lr"] = rate * share
        if self.poses is not None:
            for parameters in self.poses.optimizer.param_groups:
                parameters["lr"] = p.rate_poses * 0.01**fraction

    def pinhole(self, photo: TrainingPhoto, fraction: float) -> Pinhole:
        """The photo's camera, where its pose is refined with a gradient."""
        if self.poses is None or fraction < POSES_FROM:
            return photo.pinhole
        pose = self.poses.pose(photo.camera.name)
        return replace(photo.pinhole, cam_from_world=pose.to(photo.pinhole.cam_from_world.dtype))

    def scene(self, camera: Pinhole, fraction: float) -> Scene:
        """What is drawn now: activated, and the background's colour towards this camera."""
        with_local, with_shader = self.parts(fraction)
        background_rgb = None
        if self.background is not None:
            center = camera.center
            if camera.lens is None:
                center = sent(center, self.device)
            towards = self.background.raw["means"].detach() - center
            towards = towards / towards.norm(dim=-1, keepdim=True)
            background_rgb = sh_color(self.background.raw["sh"], towards)
        geometry, carried = self.geometry.activated()
        local, local_features = None, None
        if self.local is not None and with_local:
            local, local_features = self.local.activated()
        return Scene(
            geometry=geometry,
            carried=carried,
            shares="features" in self.geometry.raw,
            local=local,
            local_features=local_features,
            background=None if self.background is None else self.background.surfels(),
            background_rgb=background_rgb,
            shader=self.shader if with_shader else None,
            light=self.light,
        )

    def observe(self, picture: Picture, lever: float, misfit: Tensor | None = None) -> None:
        """Collect densification statistics after the backward pass.

        Args:
            lever: see `TrainingPhoto.lever`.
            misfit: () 1 where the picture is not what it should be, see `Plan`.
        """
        statistics, n = picture.maps.statistics, len(self.geometry)
        found = [(self.geometry, statistics.gradients[:n], statistics.radii[:n])]
        if self.background is not None:
            found.append((self.background, statistics.gradients[n:], statistics.radii[n:]))
        if self.local is not None and picture.local_statistics is not None:
            local = picture.local_statistics
            found.append((self.local, local.gradients, local.radii))
        sets = [(group.gradient_sum, group.seen, pull, radii) for group, pull, radii in found]
        observe(sets, scale=lever, misfit=misfit)

    def step(self, misfit: Tensor | None = None, rates: Tensor | None = None) -> None:
        """One update of everything; of nothing where `misfit` is 1.

        Args:
            rates: on a GPU, instead of those of `set_rates`; see `adam_step`.
        """
        step_all(self._sets(), self._modules(), misfit, rates)
        if self.poses is not None:
            self.poses.step(changes=misfit is None or not bool(misfit))

    def optimizers(self) -> list[torch.optim.Adam]:
        """Those that `step` steps, in its order."""
        return all_optimizers(self._sets(), self._modules())

    def _modules(self) -> list[torch.optim.Adam]:
        fitted = [] if self.exposures is None else [self.exposures.optimizer]
        return self.shader_optimizer + fitted + self.light_optimizer

    def statistics(self) -> list[Tensor]:
        """What `observe` adds to."""
        return [tensor for group in self._sets() for tensor in (group.gradient_sum, group.seen)]

    def parts(self, fraction: float) -> tuple[bool, bool]:
        """Whether local surfels and the shader take part at this fraction of the schedule."""
        with_local = self.local is not None and fraction >= self.params.local_from
        return with_local, fraction >= self.reflect_from

    def weighs_specular(self, fraction: float) -> bool:
        """Whether specular radiance is part of the loss at this fraction of the schedule."""
        p = self.params
        mirrors = self.shader is not None and self.parts(fraction)[1]
        return mirrors and p.specular_weight > 0 and fraction >= p.specular_from

    def adapts(self, iteration: int) -> bool:
        """Whether it is time to densify and prune, or to reset opacities."""
        return self._densifies(iteration) or self._resets(iteration)

    def _densifies(self, iteration: int) -> bool:
        p = self.params
        begin, end = p.densify_from * p.iterations, p.densify_until * p.iterations
        return begin < iteration < end and iteration % p.densify_every == 0

    def _resets(self, iteration: int) -> bool:
        p = self.params
        every = round(p.reset_every * p.iterations)
        return every > 0 and iteration % every == 0 and iteration <= p.densify_until * p.iterations

    def adapt(self, iteration: int, rng: torch.Generator) -> None:
        """Densify and prune, and reset opacities, each when it is time."""
        p = self.params
        if self._resets(iteration):
            for group in self._sets():
                group.reset_opacities()
        if not self._densifies(iteration):
            return
        size = p.split_size * self.extent
        rules = DensityRules(
            p.densify_gradient, size, LARGEST * self.extent, self.faintest, self.most
        )
        if self.hollow is not None:
            with torch.no_grad():
                means = self.geometry.raw["means"]
                means.copy_(self.hollow.kept_empty(means))
        own = self.around.objects(self.geometry.raw["means"].detach(), BALL_MARGIN)
        densify(self.geometry, rules, own, rng)
        if self.local is not None and iteration > p.local_from * p.iterations + p.densify_every:
            near = self.around.near(self.local.raw["means"].detach(), 4.0)
            opacity = p.local_prune_opacity
            local = DensityRules(
                p.densify_gradient, size, LARGEST * self.extent, opacity, self.most_local
            )
            densify(self.local, local, near, rng)
        if self.background is not None:
            means = self.background.raw["means"].detach()
            opacity = min(p.prune_opacity, FAINT)
            rules = DensityRules(p.densify_gradient, size, math.inf, opacity, self.most_behind)
            densify(self.background, rules, ~self.around.objects(means), rng)

    def _sets(self) -> list[TrainableSet]:
        return [s for s in (self.geometry, self.local, self.background) if s is not None]

    def _named_sets(self) -> dict[str, TrainableSet]:
        named = {"geometry": self.geometry, "local": self.local, "background": self.background}
        return {name: s for name, s in named.items() if s is not None}

    def state(self) -> dict[str, Tensor]:
        """Everything needed to continue, as named tensors."""
        out: dict[str, Tensor] = {}
        for name, group in self._named_sets().items():
            out |= {f"{name}/{k}": v for k, v in group.state().items()}
        if self.exposures is not None:
            out |= {f"exposures/{k}": v for k, v in self.exposures.state().items()}
        if self.poses is not None:
            out |= {f"poses/{k}": v for k, v in self.poses.state().items()}
        for name, module, optimizer in self._named_modules():
            for k, v in module.named_parameters():
                out[f"{name}/{k}"] = v.detach()
                moments = optimizer.state.get(v, {})
                out |= {f"{name}-adam/{k}/{m}": x for m, x in moments.items()}
        return out

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        for name, group in self._named_sets().items():
            group.restore(_below(f"{name}/", state))
        if self.exposures is not None:
            self.exposures.restore(_below("exposures/", state))
        if self.poses is not None:
            self.poses.restore(_below("poses/", state))
        with torch.no_grad():
            for name, module, optimizer in self._named_modules():
                for k, v in module.named_parameters():
                    v.copy_(state[f"{name}/{k}"])
                    given = _below(f"{name}-adam/{k}/", state)
                    moments = {n: t.to(v.device, copy=True) for n, t in given.items()}
                    if moments:
                        optimizer.state[v] = moments

    def _named_modules(self) -> list[tuple[str, torch.nn.Module, torch.optim.Adam]]:
        named: list[tuple[str, torch.nn.Module, torch.optim.Adam]] = []
        if self.shader is not None:
            named.append(("shader", self.shader, self.shader_optimizer[0]))
        if self.light is not None:
            named.append(("light", self.light, self.light_optimizer[0]))
        return named

    def freeze(self) -> SurfelField:
        """The field as an artifact."""
        empty = np.zeros
        parts = [empty(s, np.float32) for s in ((0, 3), (0, 4), (0, 2), (0,))]
        nothing = SurfelSet(parts[0], parts[1], parts[2], parts[3], {})
        p, s = self.params, self.shader
        model = ShaderModel(
            reflection=s is not None,
            local=p.local if s is not None else "none",
            mixing=p.mixing,
            physical=p.physical,
            environment=empty((0, 0, 4), np.float32) if s is None else array(s.environment),
            weights=() if s is None else tuple(array(w) for w in s.weights),
            biases=() if s is None else tuple(array(b) for b in s.biases),
            flash=None if s is None or len(s.maps()) == 1 else array(s.maps()[1]),
        )
        local = nothing if self.local is None else self.local.freeze()
        background = nothing if self.background is None else self.background.freeze()
        poses = {} if self.poses is None else self.poses.found()
        light = WORLD if self.light is None else self.light.freeze()
        geometry = self.geometry.freeze()
        return SurfelField(geometry, local, background, model, self.near, poses, lighting=light)


def _tensors(raw: RawSet) -> dict[str, Tensor]:
    """Copies, in the order in which they are optimised."""
    first = ("means", "quats", "log_scales", "raw_opacities")
    names = [*first, *(name for name in raw if name not in first)]
    return {name: torch.from_numpy(np.array(raw[name])) for name in names}


def _below(prefix: str, state: dict[str, Tensor]) -> dict[str, Tensor]:
    """What is named with this prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}


def _covered_pixels(model: SparseModel, photos: list[TrainingPhoto]) -> float:
    """Pixels of the object in the mean photo; without masks, half of the ball's disc."""
    masks = [photo.mask for photo in photos if photo.mask is not None]
    if masks:
        return float(np.mean([float((mask > 127).sum()) for mask in masks]))
    discs = []
    for photo in photos:
        distance = float(np.linalg.norm(photo.camera.center - model.ball.center))
        radius = float(photo.camera.K[0, 0]) * model.ball.radius / distance
        pixels = photo.camera.width * photo.camera.height
        discs.append(min(math.pi * radius**2, pixels) / 2)
    return float(np.mean(discs))
