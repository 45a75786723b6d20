"""Sets of surfels as the optimiser sees them, and how they grow and shrink."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.artifacts.surfel_field import SurfelSet
from refdgs_pipe.ops import Surfels, activated, adam_step, diffuse_of, rotation_matrices

_RESET_OPACITY = math.log(0.01 / 0.99)  # raw
_CURVES = {"raw_diffuse": "diffuse", "raw_roughness": "sigmoid", "features": "tanh"}
_EPSILON = 1e-15  # of Adam, as the method has it: gradients per surfel are tiny


def raw_diffuse_of(diffuse: Tensor) -> Tensor:
    """Inverse of `diffuse_of`."""
    return torch.log((diffuse * 5.0).clamp(min=1e-6))


class TrainableSet:
    """One set of surfels in optimised form, with its Adam state and densification statistics.

    `raw` maps names to leaf tensors of equal length: means (N, 3), quats (N, 4), log_scales
    (N, 2), raw_opacities (N,) and what the surfels carry: raw_diffuse, raw_roughness, features, sh.
    """

    def __init__(self, raw: dict[str, Tensor], rates: dict[str, float]) -> None:
        self.raw = {name: value.detach().clone().requires_grad_() for name, value in raw.items()}
        groups = [{"params": [p], "lr": rates[n], "name": n} for n, p in self.raw.items()]
        self.optimizer = torch.optim.Adam(groups, eps=_EPSILON, fused=True)
        self._reset_statistics()

    def __len__(self) -> int:
        return len(self.raw["means"])

    def surfels(self) -> Surfels:
        """The activated geometry."""
        raw = self.raw
        return Surfels(
            raw["means"],
            raw["quats"],
            torch.exp(raw["log_scales"]),
            torch.sigmoid(raw["raw_opacities"]),
        )

    def activated(self) -> tuple[Surfels, Tensor]:
        """The activated geometry, and side by side (N, C) what else is activated by curves."""
        raw = self.raw
        tables = [(curve, raw[name]) for name, curve in _CURVES.items() if name in raw]
        scales, opacities, carried = activated(raw["log_scales"], raw["raw_opacities"], tables)
        return Surfels(raw["means"], raw["quats"], scales, opacities), carried

    def set_rate(self, name: str, rate: float) -> None:
        """Change the step of one tensor."""
        for group in self.optimizer.param_groups:
            if group["name"] == name:
                group["lr"] = rate

    def _reset_statistics(self) -> None:
        n = len(self)
        device = self.raw["means"].device
        self.gradient_sum = torch.zeros(n, device=device)
        self.seen = torch.zeros(n, device=device)

    def rebuild(self, source: Tensor, changed: dict[str, Tensor], fresh: Tensor) -> None:
        """Replace the set by surfels copied from `source` indices (M,).

        Args:
            changed: tensors (M, ...) that are not plain copies.
            fresh: (M,) bool; these start with empty Adam moments.
        """
        for group in self.optimizer.param_groups:
            name, old = group["name"], group["params"][0]
            value = changed.get(name, old.detach()[source])
            new = value.clone().requires_grad_()
            state = self.optimizer.state.pop(old, None)
            if state:
                for moment in ("exp_avg", "exp_avg_sq"):
                    moved = state[moment][source]
                    moved[fresh] = 0
                    state[moment] = moved
                self.optimizer.state[new] = state
            group["params"][0] = new
            self.raw[name] = new
        self._reset_statistics()

    def reset_opacities(self) -> None:
        """Fade what is more opaque than 0.01 to that, so that the photos choose anew (3DGS)."""
        raw = self.raw["raw_opacities"]
        with torch.no_grad():
            raw.clamp_(max=_RESET_OPACITY)
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in self.optimizer.state.get(raw, {}):
                self.optimizer.state[raw][moment].zero_()

    def state(self) -> dict[str, Tensor]:
        """Everything needed to continue, as named tensors."""
        out = {"gradient_sum": self.gradient_sum, "seen": self.seen}
        for name, value in self.raw.items():
            out[f"raw.{name}"] = value.detach()
            for key, moment in self.optimizer.state.get(value, {}).items():
                out[f"adam.{name}.{key}"] = moment
        return out

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`, whose tensors may be on another device."""
        device = self.raw["means"].device
        state = {name: tensor.to(device) for name, tensor in state.items()}
        self.gradient_sum, self.seen = state["gradient_sum"].clone(), state["seen"].clone()
        for group in self.optimizer.param_groups:
            name = group["name"]
            new = state[f"raw.{name}"].clone().requires_grad_()
            self.optimizer.state.pop(group["params"][0], None)
            keys = ("step", "exp_avg", "exp_avg_sq")
            moments = {k: state[f"adam.{name}.{k}"] for k in keys if f"adam.{name}.{k}" in state}
            if moments:
                self.optimizer.state[new] = {k: m.clone() for k, m in moments.items()}
            group["params"][0] = new
            self.raw[name] = new

    def freeze(self) -> SurfelSet:
        """The set as an artifact."""
        with torch.no_grad():
            s = self.surfels()
            values = {
                name: array(activated.reshape(len(self), math.prod(activated.shape[1:])))
                for name, activated in _carried(self.raw).items()
            }
            quats = s.quats / s.quats.norm(dim=-1, keepdim=True)
            means, quats, scales, opacities = (
                array(p) for p in (s.means, quats, s.scales, s.opacities)
            )
            return SurfelSet(means, quats, scales, opacities, values)


def array(tensor: Tensor) -> NDArray[np.float32]:
    """A copy of a tensor, from wherever it is."""
    return np.array(tensor.detach().cpu().numpy())


def _carried(raw: dict[str, Tensor]) -> dict[str, Tensor]:
    activations: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
        "raw_diffuse": ("diffuse", diffuse_of),
        "raw_roughness": ("roughness", torch.sigmoid),
        "features": ("features", torch.tanh),
        "sh": ("sh", torch.clone),
    }
    return {new: f(raw[old]) for old, (new, f) in activations.items() if old in raw}


@dataclass(frozen=True)
class DensityRules:
    """When surfels multiply and when they go.

    Args:
        gradient: mean screen gradient to densify at.
        split_size: world units; larger surfels are split in two, smaller ones cloned.
        largest: world units; larger surfels are removed.
        opacity: fainter surfels are removed.
        most: surfels at most.
    """

    gradient: float
    split_size: float
    largest: float
    opacity: float
    most: int


def densify(group: TrainableSet, rules: DensityRules, keep: Tensor, rng: torch.Generator) -> None:
    """Clone and split where the image pulls hardest; remove the faint, the huge and the not `keep`.

    A surfel and its clone share the opacity, so that together they hide as much as one did before
    (Rota Bulo et al. 2024); else every clone of a faint local surfel would double its light.

    Args:
        keep: (N,) bool from the caller, such as inside the object ball.
    """
    with torch.no_grad():
        opacity = torch.sigmoid(group.raw["raw_opacities"])
        size = torch.exp(group.raw["log_scales"]).amax(-1)
        alive = keep & (opacity >= rules.opacity) & (size <= rules.largest)
        pull = group.gradient_sum / group.seen.clamp(min=1)
        wanted = alive & (pull >= rules.gradient)
        room = max(0, rules.most - int(alive.sum()))
        if int(wanted.sum()) > room:
            strongest = torch.where(wanted, pull, -1.0).topk(room).indices
            wanted = torch.zeros_like(wanted)
            wanted[strongest] = True
        split = wanted & (size > rules.split_size)
        kept = torch.nonzero(alive & ~split).flatten()
        cloned = torch.nonzero(wanted & ~split).flatten()
        halves = torch.nonzero(split).flatten().repeat(2)
        source = torch.cat([kept, cloned, halves])
        means = group.raw["means"].detach()[source].clone()
        scales = group.raw["log_scales"].detach()[source].clone()
        if len(halves):
            axes = rotation_matrices(group.raw["quats"].detach()[halves])[:, :, :2]
            noise = torch.randn(len(halves), 2, generator=rng).to(scales.device)
            offset = noise * torch.exp(scales[-len(halves) :])
            means[-len(halves) :] += (axes @ offset[..., None])[..., 0]
            scales[-len(halves) :] -= math.log(1.6)
        fresh = torch.zeros(len(source), dtype=torch.bool, device=source.device)
        fresh[len(kept) :] = True
        halved = torch.where(wanted & ~split, 1 - torch.sqrt(1 - opacity), opacity)
        opacities = torch.logit(halved.clamp(1e-6, 1 - 1e-6))[source]
        changed = {"means": means, "log_scales": scales, "raw_opacities": opacities}
        group.rebuild(source, changed, fresh)


def all_optimizers(
    groups: Iterable[TrainableSet | None], modules: Iterable[torch.optim.Adam]
) -> list[torch.optim.Adam]:
    """Those of the sets that are not empty, and those of modules."""
    return [*(g.optimizer for g in groups if g is not None and len(g)), *modules]


def step_all(
    groups: Iterable[TrainableSet | None],
    modules: Iterable[torch.optim.Adam],
    misfit: Tensor | None = None,
    rates: Tensor | None = None,
) -> None:
    """One optimiser step of everything, gradients cleared.

    Args:
        misfit: () on a GPU; where it is 1 nothing changes.
        rates: on a GPU, see `adam_step`.
    """
    optimizers = all_optimizers(groups, modules)
    adam_step(optimizers, misfit, rates)
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
