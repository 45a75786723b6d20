"""The unknowns of the fit of material and light, and the pictures that they make: torch's side."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.artifacts.lighting import Flash
from refdgs_pipe.lamp import highlight
from refdgs_pipe.light import (
    DIELECTRIC,
    ROUGHNESSES,
    SMOOTHEST,
    Blur,
    level_weights,
    passed_share,
    reflection_line,
    solid_angles,
)
from refdgs_pipe.ops import srgb_curve
from refdgs_pipe.texture.exposure import LeastLight
from refdgs_pipe.texture.sampling import Samples, seen_roughness

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]


_ROUGH = 1e-4  # loss for being smooth
_TOLD = 0.06  # loss for leaving what was told
_WHITE = 0.02  # loss for light that is not white


@dataclass(frozen=True)
class State:
    """The unknowns as numbers: per vertex, and the light's flat picture.

    Args:
        light: (H * 2H, 3); received: (V, 3) what a white matte surface would show.
        roughness, metallic: (V,); tint: (V, 3); gain: (V, 3), of the diffuse radiance.
        told_metallic, told_roughness: (V,) what was told, to be kept near; None before.
        told_tint: (V, 3) the same.
        known: (H * 2H,) where the light is not asked for; None: nowhere.
    """

    light: F32
    roughness: F32
    metallic: F32
    tint: F32
    gain: F32
    received: F32
    told_metallic: F32 | None = None
    told_roughness: F32 | None = None
    told_tint: F32 | None = None
    known: NDArray[np.bool_] | None = None


class Unknown:
    """The unknowns while they change: unbounded, on torch's tape.

    Args:
        balanced: whether the light is held near white, because cameras balance photos so.
        least: the least light from above; None: any.
    """

    def __init__(self, state: State, *, balanced: bool, least: LeastLight | None = None) -> None:
        def leaf(values: F32) -> Tensor:
            return torch.from_numpy(np.array(values, np.float32)).requires_grad_()

        self.light = leaf(np.log(state.light))
        self.known, self._fixed = state.known, self.light.detach().clone()
        self.rough = leaf(_logit((state.roughness - SMOOTHEST) / (1 - SMOOTHEST), 0.005)[:, None])
        self.metal = leaf(_logit(state.metallic)[:, None])
        self.tint = leaf(_logit(state.tint))
        self.gain = leaf(np.log(state.gain))
        self.received = torch.from_numpy(state.received)
        self.told_metallic, self.told_roughness = state.told_metallic, state.told_roughness
        self.told_tint, self.balanced, self.least = state.told_tint, balanced, least

    def groups(self, rate: float, *, metal: bool = True) -> list[dict[str, Any]]:
        """What Adam may change, and its step.

        Args:
            metal: whether the share of metal may change, too.
        """
        fast, slow = [self.rough], [self.light, self.tint, self.gain]
        fast += [self.metal] if metal else []
        return [{"params": fast, "lr": rate}, {"params": slow, "lr": 0.6 * rate}]

    def logs(self) -> Tensor:
        """(H * 2H, 3) logarithm of the light."""
        if self.known is None:
            return self.light
        return torch.where(torch.from_numpy(self.known)[:, None], self._fixed, self.light)

    def beyond(self) -> Tensor:
        """(H * 2H, 3) the light that is asked for; 0 where it is known."""
        if self.known is None:
            return self.light.exp()
        return torch.where(torch.from_numpy(self.known)[:, None], 0, self.light.exp())

    def _cast(self, height: int) -> Tensor:
        """How far the light that is asked for is from white, in logarithms, squared."""
        size = torch.from_numpy(solid_angles(height).reshape(-1, 1).astype(np.float32))
        mean = (size * self.beyond()).sum(0).clamp(min=1e-6).log()
        return ((mean - mean.mean()) ** 2).sum()

    def materials(self) -> Tensor:
        """(V, 11): roughness, metallic, gain 3, tint 3, received 3."""
        rough = SMOOTHEST + (1 - SMOOTHEST) * torch.sigmoid(self.rough)
        parts = [rough, torch.sigmoid(self.metal), self.gain.exp(), torch.sigmoid(self.tint)]
        return torch.cat([*parts, self.received], 1)

    def roughening(self, links: Tensor, height: int) -> Tensor:
        """What is held against unknowns that differ between neighbours, or from what was told."""
        total = 1e-4 * (self.gain**2).mean()
        # what is not seen to mirror anything is rough: smooth, it would mirror 0.04 of the light
        total = total + _ROUGH * (1 - torch.sigmoid(self.rough)).mean()
        for values, weight in (
            (self.rough, 1e-3),
            (self.metal, 3e-4),
            (self.tint, 3e-4),
            (self.gain, 1e-3),
        ):
            total = total + weight * (values[links[:, 0]] - values[links[:, 1]]).abs().mean()
        sky = self.logs().reshape(height, 2 * height, 3)
        total = total + 2e-4 * (
            (sky - sky.roll(1, 1)).abs().mean() + (sky[1:] - sky[:-1]).abs().mean()
        )
        if self.balanced:
            total = total + _WHITE * self._cast(height)
        if self.least is not None:
            total = total + self.least.missing(self.logs().exp())
        rough = SMOOTHEST + (1 - SMOOTHEST) * torch.sigmoid(self.rough)
        metal = torch.sigmoid(self.metal)
        for found, told in ((metal, self.told_metallic), (rough, self.told_roughness)):
            if told is not None:
                total = total + _TOLD * ((found[:, 0] - torch.from_numpy(told)) ** 2).mean()
        if self.told_tint is not None:
            apart = torch.sigmoid(self.tint) - torch.from_numpy(self.told_tint)
            total = total + _TOLD * (apart**2).mean()
        return total

    def state(self) -> State:
        with torch.no_grad():
            found = self.materials()
            rough, metal = (found[:, i].numpy() for i in range(2))
            return State(
                self.logs().exp().numpy(),
                rough,
                metal,
                found[:, 5:8].numpy(),
                found[:, 2:5].numpy(),
                self.received.numpy(),
                self.told_metallic,
                self.told_roughness,
                self.told_tint,
                self.known,
            )


@dataclass(frozen=True)
class Batch:
    """Some samples, ready to be drawn from the unknowns."""

    corners: Any
    looks: list[Any]
    cosine: Tensor
    diffuse: Tensor
    near: Tensor
    is_far: Tensor
    footprint: Tensor
    target: Tensor
    glint: Tensor | None = None
    shade: Tensor | None = None
    below: Tensor | None = None

    @classmethod
    def of(
        cls,
        samples: Samples,
        near: F32,
        corners: Any,
        looks: Sequence[Any],
        rows: Ints,
        *,
        flash: Flash | None = None,
        below: F32 | None = None,
    ) -> "Batch":
        """Some rows of the samples, as the field shows them.

        Args:
            near: (N, 3) radiance that mirrored rays meet on the mesh.
            corners: sparse (N, V), from vertices to samples; looks: one matrix (N, texels) for
                every level of the light.
            flash: of samples with a `glint`.
            below: (N, K, 3) of `FarLight.levels`; None where the ground's light is not known.
        """

        def tensor(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, np.float32))

        return cls(
            _Pair.of(corners[rows]),
            [_Pair.of(look[rows]) for look in looks],
            tensor(samples.cosine[rows, None]).clamp(0.02, 1),
            tensor(samples.diffuse[rows]),
            tensor(near[rows]),
            tensor(samples.near_face[rows, None] < 0),
            tensor(samples.footprint[rows, None]),
            _encoded(tensor((samples.radiance if samples.glint is None else samples.photo)[rows])),
            *_under(flash, None if samples.glint is None else tensor(samples.glint[rows])),
            None if below is None else tensor(below[rows]),
        )

    def showing(self, radiance: F32) -> "Batch":
        """The same places as they shall be: (n, 3) linear."""
        return replace(self, target=_encoded(torch.from_numpy(radiance)))

    def shown(self, unknown: Unknown, blurring: Blur) -> Tensor:
        """(n, 3) what the asset shows there, sRGB-encoded."""
        there = _Apply.apply(unknown.materials(), self.corners)  # type: ignore[no-untyped-call]
        rough, metal, gain = there[:, 0:1], there[:, 1:2], there[:, 2:5]
        tint, received = there[:, 5:8], there[:, 8:11]
        levels = _Blurred.apply(unknown.beyond(), blurring)  # type: ignore[no-untyped-call]
        far = torch.zeros_like(tint)
        seen = seen_roughness(rough, self.footprint)
        weights = level_weights(seen)
        for i, (weight, look, level) in enumerate(zip(weights, self.looks, levels, strict=True)):
            met = _Apply.apply(level, look)  # type: ignore[no-untyped-call]
            if self.below is not None:
                met = met + self.below[:, i]
            far = far + weight * met
        painted = (self.diffuse * gain / received).clamp(max=1)
        base = painted * (1 - metal) + tint * metal
        scale, offset = reflection_line(rough, self.cosine)
        f0 = DIELECTRIC * (1 - metal) + base * metal
        mirrored = (far * self.is_far + self.near) * (f0 * scale + offset)
        scattered = base * (1 - metal) * passed_share(rough, self.cosine)
        if self.glint is None or self.shade is None:
            return _encoded(scattered * received + mirrored)
        n_h, n_l, l_h, lit = (self.glint[:, i : i + 1] for i in range(4))
        lobe = highlight(n_h, n_l, l_h, self.cosine, f0, seen)
        return _encoded(received * (scattered * self.shade + lit * lobe) + mirrored)


def _under(flash: Flash | None, glint: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
    """Cosines (n, 3) and irradiance (n,) of `highlight`, and the factor (n, 1) of diffuse light.

    Both for a white matte surface that shows 1 at the lamp's distance.

    Args:
        glint: (n, 4) of `Samples`.
    """
    if flash is None or glint is None:
        return None, None
    n_h, n_l, l_h, inverse = (glint[:, i : i + 1].clamp(min=0) for i in range(4))
    shed = (1 - flash.room) * n_l * inverse * flash.distance**2
    return torch.cat([n_h.clamp(max=1), n_l, l_h, torch.pi * shed], 1), flash.room + shed


@dataclass(frozen=True)
class _Pair:
    """A sparse matrix and its transpose."""

    forward: Any
    back: Any

    @classmethod
    def of(cls, matrix: Any) -> "_Pair":
        return cls(matrix.tocsr(), matrix.T.tocsr())


class _Apply(torch.autograd.Function):
    """A sparse matrix times a dense one."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, pair: _Pair) -> Tensor:
        ctx.pair = pair
        return torch.from_numpy(np.asarray(pair.forward @ values.detach().numpy()))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(np.asarray(ctx.pair.back @ gradients[0].numpy())), None


class _Blurred(torch.autograd.Function):
    """The light's levels, sharp to rough."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, blurring: Blur) -> tuple[Tensor, ...]:
        ctx.blurring = blurring
        found = blurring(picture.detach().numpy())[: len(ROUGHNESSES)]
        return tuple(torch.from_numpy(np.array(level)) for level in found)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        matte = np.zeros((2 * ctx.blurring.heights[-1] ** 2, 3), np.float32)
        rows = [gradient.numpy() for gradient in gradients]
        return torch.from_numpy(ctx.blurring.transposed([*rows, matte])), None


def _encoded(linear: Tensor) -> Tensor:
    """sRGB of linear light, clipped at white as photos are."""
    return srgb_curve(linear.clamp(1e-5, 1))


def _logit(values: F32, least: float = 0.02) -> F32:
    """Unbounded values of what lies in 0 to 1; nearer to 0 than `least` it would hardly move."""
    inside = np.clip(values, least, 0.98).astype(np.float32)
    return np.asarray(np.log(inside / (1 - inside)), np.float32)
