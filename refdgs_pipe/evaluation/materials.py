"""The textures against the true materials, texel by texel where held-out views see them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.scores import MaterialScore, PartScore
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.evaluation.truth import MaterialTruth, TruePart
from refdgs_pipe.metrics import rank_correlation, scale_invariant_rmse
from refdgs_pipe.ray_casting import Solid, at_hits

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
_APART = 0.02  # of the object's diagonal: mesh and true surface are the same place


@dataclass(frozen=True)
class _Places:
    """Texels that one view sees, and the truth there."""

    texel: Ints
    part: Ints
    albedo: F32
    roughness: F32


def score_materials(
    textured: TexturedMesh, views: Iterable[tuple[Camera, MaterialTruth]], parts: list[TruePart]
) -> MaterialScore | None:
    """Compare the textures with the true materials; None if no view shows any of them.

    A texel counts once, with the truth of the first view that shows it.

    Args:
        views: cameras at the size of their truth.
    """
    solid = Solid(textured.mesh.vertices, textured.mesh.faces)
    seen = [_places(textured, solid, camera, truth) for camera, truth in views]
    if not sum(len(places.texel) for places in seen):
        return None
    texel, part, albedo, roughness = (
        np.concatenate([getattr(places, name) for places in seen])
        for name in ("texel", "part", "albedo", "roughness")
    )
    texel, first = np.unique(texel, return_index=True)
    part, albedo, roughness = part[first], albedo[first], roughness[first]
    base = linear_from_srgb(textured.base_color.reshape(-1, 3)[texel] / np.float32(65535))
    rough = textured.roughness.reshape(-1)[texel] / np.float32(65535)
    metal = textured.metallic.reshape(-1)[texel] / np.float32(65535)
    scores, right = [], 0
    for number, true in enumerate(parts):
        here = part == number
        if not here.any():
            continue
        is_right = (metal[here] > 0.5) == (true.metallic > 0.5)
        right += int(is_right.sum())
        scores.append(
            PartScore(
                true.name,
                int(here.sum()),
                roughness=float(np.median(rough[here])),
                true_roughness=float(np.median(roughness[here])),
                roughness_mae=float(np.abs(rough[here] - roughness[here]).mean()),
                metallic=float(np.median(metal[here])),
                true_metallic=true.metallic,
                metallic_right=float(is_right.mean()),
            )
        )
    rank = roughness_rank(rough, roughness, part, parts)
    error = scale_invariant_rmse(base, albedo)
    return MaterialScore(error, rank, right / len(texel), tuple(scores))


def roughness_rank(rough: F32, true: F32, part: Ints, parts: list[TruePart]) -> float | None:
    """Rank correlation of the materials' median roughness; parts of one material count as one.

    Args:
        rough, true: (N,) of texels; part: (N,) their places in `parts`.
    """
    names = [one.material for one in parts]
    kind = np.array([names.index(name) for name in names])[part]
    kinds = np.unique(kind)
    told, truth = (np.array([np.median(v[kind == k]) for k in kinds]) for v in (rough, true))
    return rank_correlation(told, truth.round(3))


def _places(textured: TexturedMesh, solid: Solid, camera: Camera, truth: MaterialTruth) -> _Places:
    """The texels that the pixel centres show, where mesh and truth are at the same depth."""
    mesh = textured.mesh
    rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
    hits = solid.first(camera.center.astype(np.float32), rays.astype(np.float32))
    apart = _APART * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    depth, part = truth.depth.reshape(-1)[hits.rays], truth.part.reshape(-1)[hits.rays]
    same = np.flatnonzero((np.abs(hits.distance - depth) < apart) & (part >= 0))
    uv = at_hits(mesh.uv, mesh.faces, hits.face[same], hits.weights[same])
    column, row = np.clip(uv * textured.size, 0, textured.size - 1).astype(np.int64).T
    pixels = hits.rays[same]
    return _Places(
        row * textured.size + column,
        part[same],
        truth.albedo.reshape(-1, 3)[pixels],
        truth.roughness.reshape(-1)[pixels],
    )
