"""Tangent frames as every renderer rebuilds them (MikkTSpace), and normals within them."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.texture.texels import Texels

F32 = NDArray[np.float32]

# Below this a normal map's z would tip the normal behind the surface.
_MIN_Z = 0.01


def mikktspace(mesh: UvMesh) -> F32:
    """(V, 4) unit tangents, and the sign w of bitangent = w * cross(normal, tangent).

    Images have v downwards but normal maps have green up, so v is turned over for the frames.
    """
    import open3d as o3d

    upwards = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], 1)
    solid = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.from_numpy(mesh.vertices), o3d.core.Tensor.from_numpy(mesh.faces)
    )
    solid.vertex["normals"] = o3d.core.Tensor.from_numpy(mesh.normals)
    solid.triangle["texture_uvs"] = o3d.core.Tensor.from_numpy(upwards[mesh.faces])
    solid.compute_tangent_space(bake=False)
    tangents = np.array(solid.vertex["tangents"].numpy(), np.float32)
    length = np.linalg.norm(tangents[:, :3], axis=1, keepdims=True)
    lost = ~(np.isfinite(length[:, 0]) & (length[:, 0] > 1e-6))
    tangents[:, :3] = np.where(
        lost[:, None], _any_perpendicular(mesh.normals), tangents[:, :3] / np.maximum(length, 1e-6)
    )
    tangents[:, 3] = np.where(tangents[:, 3] < 0, -1, 1)
    return tangents


def tangent_space(texels: Texels, mesh: UvMesh, tangents: F32, normals: F32) -> F32:
    """(N, 3) the texels' world normals (N, 3), as a renderer's normal map must hold them.

    Renderers use the interpolated vectors as they are, neither unit nor perpendicular; so this
    solves n = x t + y b + z m exactly, by Cramer's rule. z is kept above zero.
    """
    t = texels.interpolate(mesh, tangents[:, :3])
    m = texels.interpolate(mesh, mesh.normals)
    b = np.cross(m, t) * tangents[mesh.faces[texels.face, 0], 3:]
    volume = (t * np.cross(b, m)).sum(1)
    volume = np.where(np.abs(volume) < 1e-9, 1, volume)
    x = (normals * np.cross(b, m)).sum(1) / volume
    y = (t * np.cross(normals, m)).sum(1) / volume
    z = (t * np.cross(b, normals)).sum(1) / volume
    local = np.stack([x, y, z], 1)
    local /= np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-9)
    local[:, 2] = np.maximum(local[:, 2], _MIN_Z)
    return np.asarray(local / np.linalg.norm(local, axis=1, keepdims=True), np.float32)


def _any_perpendicular(normals: F32) -> F32:
    helper = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(1)]
    across = np.cross(normals, helper)
    return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True), np.float32)
