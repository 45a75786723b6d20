"""The normal map is baked in the frames that a renderer rebuilds from the file."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh, UvMesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.export.gltf import write_glb
from refdgs_pipe.export.product import product
from refdgs_pipe.texture.charts import unwrap
from refdgs_pipe.texture.tangents import mikktspace, tangent_space
from refdgs_pipe.texture.texels import Texels, rasterize

F64 = NDArray[np.float64]
SIZE = 256


def unit(vectors: NDArray[Any]) -> F64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float64)


@pytest.fixture(scope="module")
def mesh() -> UvMesh:
    """A dented ball, its triangles far from even, cut into charts."""
    solid = sphere(16)
    dents = 1 + 0.15 * np.sin(4 * solid.vertices).prod(1, keepdims=True)
    shaped = (solid.vertices * dents * [1.3, 1, 0.8]).astype(np.float32)
    return unwrap(Mesh(shaped, solid.faces), gutter=4 / 256, max_stretch=0.1667, timeout_s=60).mesh


@pytest.fixture(scope="module")
def baked(mesh: UvMesh) -> tuple[TexturedMesh, Texels, F64]:
    """The mesh with a map of normals that lean up to 50 degrees, and those normals."""
    texels, tangents = rasterize(mesh, SIZE), mikktspace(mesh)
    points = texels.interpolate(mesh, mesh.vertices)
    plain = unit(texels.interpolate(mesh, mesh.normals))
    wanted = unit(plain + 0.6 * np.sin(9 * points[:, [1, 2, 0]]))
    local = tangent_space(texels, mesh, tangents, wanted.astype(np.float32))

    def texture(values: NDArray[Any]) -> NDArray[np.uint16]:
        return texels.picture(np.round(values * 65535).astype(np.uint16))

    grey = texture(np.full(len(points), 0.5))
    return (
        TexturedMesh(
            mesh,
            tangents,
            base_color=np.stack([grey] * 3, -1),
            roughness=grey,
            metallic=grey,
            occlusion=grey,
            normal=texture(local * 0.5 + 0.5),
            confidence=grey,
        ),
        texels,
        wanted,
    )


def as_mikkelsen_has_it(mesh: UvMesh) -> F64:
    """(V, 3) tangents by the definition of MikkTSpace (Mikkelsen's mikktspace.c, 2011).

    The tangent of each face's texture coordinates, put into the plane of the vertex's normal, unit,
    weighted by the angle that the face has there, summed over the faces that meet in the vertex.
    """
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    uv = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], 1).astype(np.float64)  # green is up
    a, b, c = mesh.faces.T
    along, across = points[b] - points[a], points[c] - points[a]
    (s1, t1), (s2, t2) = (uv[b] - uv[a]).T, (uv[c] - uv[a]).T
    face_tangent = unit((t2[:, None] * along - t1[:, None] * across) / (s1 * t2 - s2 * t1)[:, None])
    total = np.zeros_like(points)
    for here, after, before in ((a, b, c), (b, c, a), (c, a, b)):
        n = normals[here]

        def flat(vectors: F64, n: F64 = n) -> F64:
            return unit(vectors - (vectors * n).sum(1, keepdims=True) * n)

        first, second = flat(points[after] - points[here]), flat(points[before] - points[here])
        angle = np.arccos(np.clip((first * second).sum(1), -1, 1))
        np.add.at(total, here, angle[:, None] * flat(face_tangent))
    return unit(total)


def test_tangents_are_those_of_mikktspaces_definition(mesh: UvMesh) -> None:
    found = mikktspace(mesh)
    cosine = (found[:, :3] * as_mikkelsen_has_it(mesh)).sum(1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1
    assert np.abs((found[:, :3] * mesh.normals).sum(1)).max() < 1e-5
    assert set(found[:, 3]) == {1.0}


class Glb:
    """What a viewer finds in the file, as it lies there."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        self.document = json.loads(data[20 : 20 + length])
        self._bytes = data[28 + length :]
        (primitive,) = self.document["meshes"][0]["primitives"]
        self.attributes = primitive["attributes"]
        self.faces = self.array(primitive["indices"]).reshape(-1, 3).astype(np.int32)

    def array(self, accessor: int) -> NDArray[Any]:
        record = self.document["accessors"][accessor]
        view = self.document["bufferViews"][record["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[record["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[record["type"]]
        values = np.frombuffer(self._bytes, kind, record["count"] * width, view["byteOffset"])
        return values.reshape(-1, width)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.array(self.attributes[name])


@pytest.mark.parametrize("viewer", ["MikkTSpace", "three.js", "Khronos sample viewer"])
def test_what_a_viewer_makes_of_the_file_are_the_normals_that_were_baked(
    baked: tuple[TexturedMesh, Texels, F64], viewer: str, tmp_path: Path
) -> None:
    textured, texels, wanted = baked
    made = product(textured, up=np.array([0.0, 0.0, 1.0]), metres_per_unit=0.1)
    write_glb(tmp_path / "asset.glb", made, generator="test")
    file = Glb(tmp_path / "asset.glb")
    shape = UvMesh(file["POSITION"], file["NORMAL"], file["TEXCOORD_0"], file.faces)
    tangent, sign = file["TANGENT"][:, :3], file["TANGENT"][:, 3:]
    n, t = (texels.interpolate(shape, values) for values in (file["NORMAL"], tangent))
    if viewer == "MikkTSpace":  # what it asks of renderers: nothing made unit, made in the pixel
        b = np.cross(n, t) * sign[file.faces[texels.face, 0]]
    else:  # the bitangent is made in the vertex, all three are made unit in the pixel
        b = texels.interpolate(shape, np.cross(file["NORMAL"], tangent) * sign)
        n, t, b = unit(n), unit(t), unit(b)
    x, y, z = (made.normal.reshape(-1, 3)[texels.index] / 255 * 2 - 1).T[..., None]
    normal = unit(x * t + y * b + z * n)
    upright = wanted @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # +Z up to +Y up
    angle = np.degrees(np.arccos(np.clip((normal * upright).sum(1), -1, 1)))
    bound = 0.5 if viewer == "MikkTSpace" else 2.0  # eight bits are 0.3 degrees
    assert angle.mean() < bound / 2 and np.quantile(angle, 0.99) < bound


def test_the_sign_of_the_bitangent_turns_green_over(
    baked: tuple[TexturedMesh, Texels, F64],
) -> None:
    textured, texels, wanted = baked
    flipped = textured.tangents * np.float32([1, 1, 1, -1])
    local = tangent_space(texels, textured.mesh, flipped, wanted.astype(np.float32))
    right = textured.normal.reshape(-1, 3)[texels.index] / 65535 * 2 - 1
    np.testing.assert_allclose(local * [1, -1, 1], right, atol=1e-3)
