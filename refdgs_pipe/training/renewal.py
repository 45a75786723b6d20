"""Surfels that start anew on the field's own mesh.

In the course of training several sheets of discs come to share one surface, and each view sees its
own mixture of them. A mesh that is fused from all views, and fitted to their outlines, is one
surface; discs that lie on it, turned as it is turned, go on from there.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surfel_field import SurfelSet
from refdgs_pipe.training.initial import Cloud, raw_discs
from refdgs_pipe.training.surfels import TrainableSet

F64 = NDArray[np.float64]

OPACITY = 0.9
OVERLAP = 0.6  # standard deviation of a disc, in the distances between discs


@dataclass(frozen=True)
class Renewal:
    """What surfels start anew on, and how.

    Args:
        mesh: of the field's own views; None: there is none, and `why_not` says why.
        surfels: that start for each that was there, a factor.
        most: surfels at most, unless more were there.
        turning: share of the rotations' rate that is left from then on: discs are turned as all
            views agree, and what photos hardly tell is not to be shaken by steps that are as large
            whatever the gradient.
    """

    mesh: TriangleMesh | None
    why_not: str
    surfels: float
    most: int
    turning: float


@dataclass(frozen=True)
class Fresh:
    """Surfels that are to replace a set's.

    Args:
        source: (M,) which surfel of the set each takes after; raw: what it does not take over.
    """

    source: Tensor
    raw: dict[str, Tensor]

    def replace(self, group: TrainableSet) -> None:
        """Let them take the place of the set that they were made for."""
        group.rebuild(self.source, self.raw, torch.ones_like(self.source, dtype=torch.bool))

    def frozen(self, group: TrainableSet) -> SurfelSet:
        """What the set would then be."""
        raw = {
            name: self.raw.get(name, old.detach()[self.source]) for name, old in group.raw.items()
        }
        return TrainableSet(raw, dict.fromkeys(raw, 0.0)).freeze()


def renewed(group: TrainableSet, mesh: TriangleMesh, count: int, rng: np.random.Generator) -> Fresh:
    """`count` discs on a mesh, which carry what the nearest surfels of a set carry."""
    cloud = discs_on(mesh, count, rng)
    device = group.raw["means"].device
    before = group.raw["means"].detach().cpu().numpy()
    nearest = torch.from_numpy(cKDTree(before).query(cloud.points)[1]).to(device)
    raw = {name: value.to(device) for name, value in raw_discs(cloud, OPACITY).items()}
    return Fresh(nearest, raw)


def discs_on(mesh: TriangleMesh, count: int, rng: np.random.Generator) -> Cloud:
    """Discs spread evenly over a mesh by area, with its smooth normals."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    total = float(area.sum())
    places = (np.arange(count) + rng.random(count)) / count * total
    face = np.minimum(np.searchsorted(area.cumsum(), places), len(area) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], 1)

    def at(values: NDArray[np.float32]) -> F64:
        found = np.einsum("nk,nkc->nc", weights, values[mesh.faces[face]].astype(np.float64))
        return np.asarray(found, np.float64)

    normals = at(mesh.vertex_normals())
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    sizes = np.full(count, OVERLAP * math.sqrt(total / count))
    return Cloud(at(mesh.vertices), normals, sizes, np.zeros((count, 3)))
