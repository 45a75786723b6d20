"""One object in many files: of the same size, the same way up, with the same things said of it."""

import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest
from painted import textured
from PIL import Image
from scenes import orbit

from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.export.about import about_asset
from refdgs_pipe.export.files import Surroundings, writers
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.product import product, scale_of
from refdgs_pipe.files.ply import read_ply

UP = np.array([0.0, 0.6, 0.8])
LONGEST = 0.37  # metres
SOURCES = ["shoot/IMG 1.jpg", "shoot/ä (2).jpg"]
# The object's box: the ball of radius 1, whatever its up vector, stretched along world x.
STRETCH = np.array([2.0, 1.0, 1.0], np.float32)


def stretched() -> TexturedMesh:
    made = textured(64)
    vertices = made.mesh.vertices * STRETCH
    object.__setattr__(made.mesh, "vertices", vertices)
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("asset")
    mesh = stretched()
    scale, told = scale_of(mesh.mesh, known=None, longest=LONGEST)
    about = about_asset("some/where/own.toml", SOURCES, scale, told)
    made = product(mesh, up=UP, metres_per_unit=scale, about=about)
    frame = AssetFrame.of(UP, scale)
    around = Surroundings(frame, np.ones((8, 16, 3), np.float32), orbit(2), surfels(mesh))
    for write in writers(around, preview=64):
        write(folder, made)
    return folder


def surfels(mesh: TexturedMesh) -> Any:
    """A surfel at each vertex."""
    count = len(mesh.mesh.vertices)
    return type(finished.field().geometry)(
        means=mesh.mesh.vertices,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 2), 0.01, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        values={"diffuse": np.full((count, 3), 0.5, np.float32)},
    )


def glb_record(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def points_of(path: Path) -> np.ndarray:
    """(N, 3) metres with +Y up, as each format says that they are to be understood."""
    if path.suffix == ".glb":  # metres and +Y up by definition; no node may move it
        record, binary = glb_record(path)
        assert all(set(node) <= {"name", "mesh"} for node in record["nodes"])
        attributes = record["meshes"][0]["primitives"][0]["attributes"]
        accessor = record["accessors"][attributes["POSITION"]]
        start = record["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(binary, "<f4", accessor["count"] * 3, start).reshape(-1, 3)
    if path.suffix == ".obj":
        assert "# unit: metre" in path.read_text() and "# up: +Y" in path.read_text()
        lines = path.read_text().splitlines()
        return np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    if path.suffix == ".ply":
        ply = read_ply(path)
        return np.stack([ply.columns[axis] for axis in "xyz"], 1)
    return usd_points(path)


def usd_points(path: Path) -> np.ndarray:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    for prim in stage.Traverse():
        for name in ("points", "positions"):
            if prim.GetTypeName() in ("Mesh", "ParticleField") and prim.GetAttribute(name):
                matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
                local = np.array(prim.GetAttribute(name).Get())
                return (np.c_[local, np.ones(len(local))] @ matrix)[:, :3] * unit
    raise AssertionError(f"{path}: no points")


FILES = [
    "asset.glb",
    "asset.usdc",
    "asset.usdz",
    "asset.obj",
    "scene.usda",
    "splats.ply",
    "splats.usdc",
]


@pytest.mark.parametrize("name", FILES)
def test_the_object_measures_the_same_in_every_file(name: str, folder: Path) -> None:
    world = stretched().mesh.vertices
    scale = LONGEST / np.ptp(world, axis=0).max()
    if not (folder / name).exists():
        pytest.skip("this USD has no particle fields")
    points = points_of(folder / name)
    size = np.ptp(points, axis=0)
    # From the definition: +Y is the world's up; x stays x for an up vector in the y-z plane.
    along = (np.ptp(world[:, 0]), np.ptp(world @ UP), np.ptp(world @ np.array([0, -0.8, 0.6])))
    np.testing.assert_allclose(size, np.array(along) * scale, rtol=1e-3)
    assert abs(size.max() - LONGEST) < 1e-3 * LONGEST
    np.testing.assert_allclose(points.max(0)[1], (world @ UP).max() * scale, rtol=1e-3)


def test_every_format_says_how_it_was_made(folder: Path) -> None:
    from pxr import Usd

    expected = {"tool": "refdgs-pipe", "recipe": "own", "unit": "metre", "scale": "given"}
    expected |= {"photos": ["IMG 1.jpg", "ä (2).jpg"]}
    record, _ = glb_record(folder / "asset.glb")
    extras = record["asset"]["extras"]
    assert extras.items() >= expected.items() and extras["version"]
    for name in ("asset.usdc", "asset.usdz", "scene.usda"):
        stage = Usd.Stage.Open(str(folder / name))
        data = stage.GetDefaultPrim().GetCustomDataByKey("refdgs")
        assert {k: list(v) if k == "photos" else v for k, v in data.items()} == extras, name
    text = (folder / "asset.obj").read_text("utf-8")
    assert "# recipe: own\n" in text and "# photos: IMG 1.jpg, ä (2).jpg\n" in text
    for path in folder.glob("asset.*"):
        assert b"shoot" not in path.read_bytes() and b"some/where" not in path.read_bytes()


def test_a_name_with_a_line_break_stays_in_its_comment(tmp_path: Path) -> None:
    from refdgs_pipe.export.obj import write_obj

    about = about_asset("r", ["a\nv 1 2 3\r.jpg"], 1.0, "given")
    made = product(textured(64), up=UP, metres_per_unit=1.0, about=about)
    write_obj(tmp_path / "a.obj", made, textures="t")
    lines = (tmp_path / "a.obj").read_text("utf-8").splitlines()
    assert sum(line.startswith("v ") for line in lines) == len(made.vertices)


def test_the_material_of_the_obj_names_every_texture(folder: Path) -> None:
    lines = [line.split() for line in (folder / "asset.mtl").read_text().splitlines()]
    maps = {line[0]: line[1] for line in lines if line[0].startswith(("map_", "norm"))}
    assert set(maps) == {"map_Kd", "map_Pr", "map_Pm", "norm"}
    for name in maps.values():
        Image.open(folder / name).verify()


def test_the_usdz_keeps_the_rules_of_ar_quick_look(folder: Path) -> None:
    """Package, stage and material, by the rules that usdchecker's --arkit had."""
    from pxr import Usd, UsdGeom, UsdShade

    data = (folder / "asset.usdz").read_bytes()
    package = zipfile.ZipFile(io.BytesIO(data))
    entries = package.infolist()
    assert entries[0].filename == "asset.usdc"
    for entry in entries:
        name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        assert (entry.header_offset + 30 + name + extra) % 64 == 0, entry.filename
        assert entry.compress_type == zipfile.ZIP_STORED
        assert entry.filename.endswith((".usdc", ".jpg", ".png"))
        assert not entry.flag_bits & 1  # not encrypted
    stage = Usd.Stage.Open(str(folder / "asset.usdz"))
    assert UsdGeom.StageHasAuthoredMetersPerUnit(stage) and UsdGeom.GetStageUpAxis(stage) == "Y"
    assert [prim.GetName() for prim in stage.GetPseudoRoot().GetChildren()] == ["object"]
    assert stage.GetDefaultPrim().GetName() == "object"
    for prim in stage.Traverse():
        parent = prim.GetParent()
        assert prim.GetTypeName() in ("Xform", "Mesh", "Material", "Shader")
        assert not parent.IsA(UsdGeom.Gprim)  # nothing below a mesh
        assert not prim.IsA(UsdShade.Shader) or parent.IsA(UsdShade.Material)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/object/mesh"))
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and mesh.GetExtentAttr().Get()
    assert mesh.GetPrim().HasAPI(UsdShade.MaterialBindingAPI)
    coordinates = UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues()
    assert [(p.GetPrimvarName(), str(p.GetTypeName())) for p in coordinates] == [
        ("st", "texCoord2f[]")
    ]


def test_the_material_of_the_usdz_is_a_plain_preview_surface(folder: Path) -> None:
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(folder / "asset.usdz"))
    package = zipfile.ZipFile(folder / "asset.usdz")
    surface = UsdShade.Shader(stage.GetPrimAtPath("/object/material/surface"))
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    expected = {
        "diffuseColor": ("sRGB", "rgb", "JPEG", "RGB"),
        "roughness": ("raw", "r", "PNG", "L"),
        "metallic": ("raw", "r", "PNG", "L"),
        "normal": ("raw", "rgb", "PNG", "RGB"),
    }
    for name, (space, output, kind, mode) in expected.items():
        source, channel, _ = surface.GetInput(name).GetConnectedSource()
        shader = UsdShade.Shader(source.GetPrim())
        assert shader.GetIdAttr().Get() == "UsdUVTexture" and channel == output
        assert shader.GetInput("sourceColorSpace").Get() == space
        path = shader.GetInput("file").Get()
        assert path.resolvedPath.endswith(f"asset.usdz[{path.path}]")
        picture = Image.open(io.BytesIO(package.read(path.path)))
        assert (picture.format, picture.mode) == (kind, mode), name
        assert picture.width & (picture.width - 1) == 0
        if name == "normal":
            assert tuple(shader.GetInput("scale").Get()) == (2, 2, 2, 1)
            assert tuple(shader.GetInput("bias").Get()) == (-1, -1, -1, 0)
