"""The path-traced scenes with known truth, where a checkout has them beside it."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera, opencv_from_opengl
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.files.ply import read_mesh

F32 = NDArray[np.float32]
SCENES = Path(__file__).resolve().parents[2] / "shared" / "data" / "scenes"

needs_scenes = pytest.mark.skipif(
    not SCENES.is_dir(), reason="the path-traced scenes are not beside this checkout"
)


def cameras(name: str, split: str = "test") -> list[Camera]:
    """The scene's cameras, 320 x 320."""
    record = json.loads((SCENES / name / f"transforms_{split}.json").read_text())
    size = 320
    focal = size / 2 / np.tan(record["camera_angle_x"] / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return [
        Camera(
            Path(frame["file_path"]).name,
            size,
            size,
            K,
            opencv_from_opengl(np.array(frame["transform_matrix"], float)),
            split,
        )
        for frame in record["frames"]
    ]


def surface_map(name: str, camera: Camera) -> SurfaceMap:
    """The true maps of a test view.

    Metals have no diffuse colour: what they show is specular. The rest has no specular here.
    """
    from PIL import Image

    folder = SCENES / name / "test"

    def picture(kind: str) -> F32:
        with Image.open(folder / f"{camera.name}{kind}.png") as image:
            return np.asarray(image, np.float32) / 255

    data = np.load(folder / f"{camera.name}_depth.npz")
    depth = data["depth"].astype(np.float32)
    here = (depth > 0)[..., None]
    normal = picture("_normal")[..., :3] * 2 - 1
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    rgba = picture("")
    metal = np.isin(data["object_id"], metals(name))[..., None]
    return SurfaceMap(
        camera,
        depth=depth,
        alpha=here[..., 0].astype(np.float32),
        normal=np.where(here, normal, 0),
        diffuse=np.where(here & ~metal, linear_from_srgb(picture("_albedo")[..., :3]), 0),
        specular=np.where(metal, linear_from_srgb(rgba[..., :3]), 0),
        roughness=np.where(here[..., 0], np.sqrt(data["alpha_ggx"] / np.float32(255)), 0),
        color=rgba[..., :3] * rgba[..., 3:],
    )


def metals(name: str) -> list[int]:
    """The ids of the objects made of metal."""
    record = json.loads((SCENES / name / "materials.json").read_text())
    return [item["object_id"] for item in record if item["metallic"] > 0.5]


def surface_maps(name: str) -> list[SurfaceMap]:
    """The true maps of all test views."""
    return [surface_map(name, camera) for camera in cameras(name)]


def ball(name: str) -> Ball:
    """The ball the scene lies in."""
    record = json.loads((SCENES / name / "points3d_bounds.json").read_text())
    return Ball(np.array(record["center"]), record["radius"])


def sparse_model(name: str) -> SparseModel:
    """The scene's test cameras as a model without points."""
    return SparseModel(
        cameras=tuple(cameras(name)),
        lenses={},
        points=np.empty((0, 3)),
        point_colors=np.empty((0, 3), np.uint8),
        tracks={},
        ball=ball(name),
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def mesh(name: str) -> tuple[F32, NDArray[np.int32]]:
    """Vertices and faces of the true surface that some camera sees."""
    data = read_mesh(SCENES / name / "gt_mesh.ply")
    return data.vertices, data.faces


def distances(points: F32, vertices: F32, faces: NDArray[np.int32]) -> F32:
    """(N,) distance of points (N, 3) to a triangle mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    found = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32)))
    return np.asarray(found.numpy())


def errors(textured: TexturedMesh, view: SurfaceMap) -> tuple[float, float, float, float, float]:
    """How far a textured mesh is from a true view of a scene.

    Returns:
        base colour (linear, mean, where it is no metal); angle in degrees of the normal map's and
        of the mesh's own normals; mean metallic on metal (nan: no metal in view) and elsewhere.
    """
    import open3d as o3d

    mesh, camera = textured.mesh, view.camera
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
    cast = np.concatenate([np.broadcast_to(camera.center, rays.shape), rays], 1)
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(cast.astype(np.float32)))
    away = np.abs(hits["t_hit"].numpy() - view.depth.reshape(-1))
    pixels = np.flatnonzero(away < 0.02)
    b, c = hits["primitive_uvs"].numpy()[pixels].T
    weights = np.stack([1 - b - c, b, c], 1)
    corners = mesh.faces[hits["primitive_ids"].numpy()[pixels]]

    def at(values: F32) -> F32:
        return np.einsum("nk,nkc->nc", weights, values[corners])

    column, row = np.clip(at(mesh.uv) * textured.size, 0, textured.size - 1).astype(int).T
    base = linear_from_srgb(textured.base_color[row, column] / np.float32(65535))
    metallic = textured.metallic[row, column] / 65535
    local = textured.normal[row, column] / 32767.5 - 1
    tangent, plain = at(textured.tangents[:, :3]), at(mesh.normals)
    across = np.cross(plain, tangent) * textured.tangents[corners[:, 0], 3:]
    mapped = local[:, :1] * tangent + local[:, 1:2] * across + local[:, 2:] * plain
    true = view.normal.reshape(-1, 3)[pixels]

    def angle(normals: F32) -> float:
        unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return float(np.degrees(np.arccos(np.clip((unit * true).sum(1), -1, 1))).mean())

    metal = view.specular.reshape(-1, 3)[pixels].any(1)
    wrong = np.abs(base - view.diffuse.reshape(-1, 3)[pixels]).mean(1)
    on_metal = float(metallic[metal].mean()) if metal.any() else float("nan")
    elsewhere = float(metallic[~metal].mean())
    return float(wrong[~metal].mean()), angle(mapped), angle(plain), on_metal, elsewhere
