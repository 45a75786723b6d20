"""Surfels that start anew on the field's own mesh.

In the course of training several sheets of discs come to share one surface, and each view sees its
own mixture of them. A mesh that is fused from all views, and fitted to their outlines, is one
surface; discs that lie on it, turned as it is turned, go on from there.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.training.initial import Cloud, raw_discs
from refdgs_pipe.training.surfels import TrainableSet

F64 = NDArray[np.float64]

OPACITY = 0.9
OVERLAP = 0.6  # standard deviation of a disc, in the distances between discs


def renew(group: TrainableSet, mesh: TriangleMesh, count: int, rng: np.random.Generator) -> None:
    """Replace a set's surfels by `count` discs on a mesh, which carry what the nearest carried."""
    cloud = discs_on(mesh, count, rng)
    device = group.raw["means"].device
    before = group.raw["means"].detach().cpu().numpy()
    nearest = torch.from_numpy(cKDTree(before).query(cloud.points)[1]).to(device)
    raw = {name: value.to(device) for name, value in raw_discs(cloud, OPACITY).items()}
    group.rebuild(nearest, raw, torch.ones(count, dtype=torch.bool, device=device))


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
