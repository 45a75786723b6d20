"""Exported files are valid, the right way up, of the right size, and say the same thing."""

import json
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from painted import textured
from scenes import orbit
from scipy.spatial.transform import Rotation
from solids import sphere

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.surfel_field import SurfelSet
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.errors import CorruptError, ExportError, ShapeError
from refdgs_pipe.export import files
from refdgs_pipe.export.about import about_asset
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.preview import render_preview
from refdgs_pipe.export.product import Product, product, scale_of
from refdgs_pipe.export.splats import in_asset_frame, write_particle_field, write_splats
from refdgs_pipe.export.turntable import (
    INSIDE,
    MUCH,
    UNSEEN,
    render_close_up,
    render_coverage,
    render_turntable,
)
from refdgs_pipe.export.usd import write_usdz
from refdgs_pipe.export.validate import glb_faults, require, usd_faults
from refdgs_pipe.files.ply import read_ply
from refdgs_pipe.texture.charts import seam_split
from refdgs_pipe.texture.programs import one_by_one_corners

VALIDATOR = Path(__file__).parent / "validate_gltf.js"
FRAME = AssetFrame.of(np.array([0.0, 0.0, 1.0]), 0.1)
ABOUT = about_asset("my/own.toml", ["a/ä.jpg", 'b/"2".jpg'], 0.1, "given")


@pytest.fixture(scope="module")
def ball() -> Product:
    return product(textured(), up=np.array([0.0, 0.0, 1.0]), metres_per_unit=0.1, about=ABOUT)


@pytest.fixture(scope="module")
def folder(ball: Product, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("asset")
    for write in files.writers(preview=96):
        write(folder, ball)
    return folder


def test_the_product_stands_upright_in_metres(ball: Product) -> None:
    low, high = ball.vertices.min(0), ball.vertices.max(0)
    np.testing.assert_allclose([low, high], [[-0.1, 0, -0.1], [0.1, 0.2, 0.1]], atol=1e-6)
    assert not ball.is_open and ball.has_metal
    outward = ball.vertices - [0, 0.1, 0]
    assert ((ball.normals * outward).sum(1) > 0).all()


def test_the_scale_is_what_is_known_or_said() -> None:
    solid = sphere(6, radius=2.0)
    mesh = seam_split(Mesh(solid.vertices, solid.faces), one_by_one_corners(len(solid.faces)))
    assert scale_of(mesh, known=None, longest=None) == (1, "unknown")
    assert scale_of(mesh, known=0.3, longest=None) == (0.3, "known from the capture")
    scale, told = scale_of(mesh, known=0.3, longest=0.2)
    assert abs(scale - 0.05) < 1e-6 and told == "given"


def test_every_file_passes_its_check(folder: Path) -> None:
    assert glb_faults(folder / "asset.glb") == []
    assert usd_faults(folder / "asset.usdc") == []
    assert usd_faults(folder / "asset.usdz") == []


@pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")
def test_khronos_validator_has_nothing_to_say(folder: Path) -> None:
    run = subprocess.run(
        ["node", str(VALIDATOR), str(folder / "asset.glb")], capture_output=True, text=True
    )
    if run.returncode == 3:
        pytest.skip("the npm package gltf-validator is not installed")
    report = json.loads(run.stdout)
    counts = [report["issues"][k] for k in ("numErrors", "numWarnings", "numInfos", "numHints")]
    assert counts == [0, 0, 0, 0], report["issues"]["messages"]


def test_all_formats_hold_the_same_mesh(folder: Path, ball: Product) -> None:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(folder / "asset.usdz"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/object/mesh"))
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get()), ball.vertices)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    lines = (folder / "asset.obj").read_text().splitlines()
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(points, ball.vertices, atol=1e-6)
    st = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
    np.testing.assert_allclose(st[:, 1], 1 - ball.uv[:, 1], atol=1e-6)
    data = (folder / "asset.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    record = json.loads(data[20 : 20 + length])
    assert "/" not in json.dumps(record["asset"])  # no paths
    stored = np.frombuffer(data, "<f4", ball.vertices.size, 28 + length).reshape(-1, 3)
    np.testing.assert_array_equal(stored, ball.vertices)
    for line in (folder / "asset.mtl").read_text().splitlines():
        if line.startswith(("map_", "norm")):
            assert (folder / line.split()[1]).is_file()


def test_roughness_is_green_and_metal_blue(folder: Path) -> None:
    import cv2

    data = (folder / "asset.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    record = json.loads(data[20 : 20 + length])
    view = record["bufferViews"][record["images"][1]["bufferView"]]
    start = 28 + length + view["byteOffset"]
    picture = cv2.imdecode(
        np.frombuffer(data[start : start + view["byteLength"]], np.uint8), cv2.IMREAD_COLOR
    )
    assert (picture[..., 1] == 51).all()  # 0.2
    assert set(np.unique(picture[..., 0])) == {0, 255}


def damaged(folder: Path, tmp_path: Path, change: tuple[int, bytes]) -> Path:
    data = bytearray((folder / "asset.glb").read_bytes())
    offset, content = change
    if offset < 0:
        offset += len(data)
    data[offset : offset + len(content)] = content
    path = tmp_path / "asset.glb"
    path.write_bytes(bytes(data))
    return path


def test_damaged_glbs_are_found_out(folder: Path, tmp_path: Path) -> None:
    data = (folder / "asset.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    binary = 28 + length
    nan = struct.pack("<f", float("nan"))
    for change in (
        (0, b"glTX"),
        (8, b"\1\0\0\0"),
        (20, b"?"),
        (binary, nan),
        (binary, b"\0\0\x80\x41"),
    ):
        assert glb_faults(damaged(folder, tmp_path, change)), change
    for cut in (10, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.glb").write_bytes(data[:cut])
        assert glb_faults(tmp_path / "cut.glb")
    with pytest.raises(ExportError, match=r"cut\.glb did not pass its check"):
        require(tmp_path / "cut.glb", glb_faults(tmp_path / "cut.glb"))


def test_damaged_usd_is_found_out(folder: Path, tmp_path: Path) -> None:
    data = (folder / "asset.usdz").read_bytes()
    (tmp_path / "cut.usdz").write_bytes(data[: len(data) // 2])
    assert usd_faults(tmp_path / "cut.usdz")
    data = (folder / "asset.usdc").read_bytes()
    (tmp_path / "cut.usdc").write_bytes(data[: len(data) // 2])
    assert usd_faults(tmp_path / "cut.usdc")


def test_a_missing_texture_stops_the_usdz(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "asset.usdc", tmp_path / "asset.usdc")
    with pytest.raises(ExportError, match="cannot be packed"):
        write_usdz(tmp_path / "a.usdz", tmp_path / "asset.usdc", [tmp_path / "textures" / "x.png"])
    assert not (tmp_path / "a.usdz").exists()
    assert usd_faults(tmp_path / "asset.usdc")  # its textures are not there


def test_the_preview_shows_the_object(ball: Product) -> None:
    picture = render_preview(ball, side=96)
    assert picture.shape == (96, 288, 3)
    corners = picture[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners == corners[0]).all()
    shown = (picture != corners[0]).any(2).mean()
    assert 0.5 < shown < 0.8  # three discs that nearly fill their squares


def test_a_turntable_shows_the_same_outline_painted_and_as_triangles(ball: Product) -> None:
    turns = render_turntable(ball, count=3, side=64, threads=2)
    assert len(turns) == 3
    for turn in turns:
        assert turn.painted.shape == turn.wire.shape == (64, 64, 4)
        np.testing.assert_array_equal(turn.painted[..., 3], turn.wire[..., 3])
        covered = (turn.painted[..., 3] > 127).mean()
        assert 0.5 < covered < 0.8  # a disc that nearly fills its square
    assert np.abs(turns[0].painted.astype(int) - turns[1].painted).max() > 40  # its other side
    close = render_close_up(ball, side=64, zoom=4.0)
    assert (close.wire[..., 3] == 255).all()
    grey = close.wire[..., :3].mean(2)
    assert 0.02 < (grey < 0.6 * grey.max()).mean() < 0.5  # dark lines on light clay


def surfels(count: int = 7) -> SurfelSet:
    random = np.random.default_rng(0)
    quats = random.normal(size=(count, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return SurfelSet(
        means=random.normal(size=(count, 3)).astype(np.float32),
        quats=quats,
        scales=random.random((count, 2), np.float32),
        opacities=random.random(count, np.float32),
        values={"diffuse": random.random((count, 3), np.float32)},
    )


def test_splats_follow_the_2dgs_convention(tmp_path: Path) -> None:
    some = surfels()
    write_splats(tmp_path / "s.ply", some)
    ply = read_ply(tmp_path / "s.ply")
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3"
    assert list(ply.columns) == names.split() and ply.comments == ("SplatRenderMode: 2dgs",)
    opacities = 1 / (1 + np.exp(-ply.columns["opacity"]))
    np.testing.assert_allclose(opacities, some.opacities, atol=1e-5)
    np.testing.assert_allclose(np.exp(ply.columns["scale_1"]), some.scales[:, 1], rtol=1e-5)
    shown = np.stack([ply.columns[f"f_dc_{i}"] for i in range(3)], 1) * 0.28209479 + 0.5
    np.testing.assert_allclose(linear_from_srgb(shown), some.values["diffuse"], atol=1e-4)
    normals = np.stack([ply.columns[n] for n in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_splats_stand_where_the_asset_stands() -> None:
    some = surfels()
    turned = in_asset_frame(some, FRAME)
    np.testing.assert_allclose(turned.means, FRAME.points(some.means), atol=1e-6)
    np.testing.assert_allclose(turned.scales, 0.1 * some.scales, rtol=1e-6)
    before = Rotation.from_quat(some.quats, scalar_first=True).as_matrix()
    after = Rotation.from_quat(turned.quats, scalar_first=True).as_matrix()
    np.testing.assert_allclose(after, FRAME.turn @ before, atol=1e-6)
    with pytest.raises(ShapeError, match=r"\[6, 7\]"):
        in_asset_frame(replace(some, means=some.means[:6]), FRAME)
    with pytest.raises(ShapeError, match="no diffuse colour"):
        in_asset_frame(replace(some, values={}), FRAME)


def test_surflets_in_usd_say_what_the_ply_says(tmp_path: Path) -> None:
    from pxr import Usd, UsdVol

    some = surfels()
    if not write_particle_field(tmp_path / "s.usdc", some, ABOUT):
        pytest.skip("this USD has no particle fields")
    assert usd_faults(tmp_path / "s.usdc") == []
    stage = Usd.Stage.Open(str(tmp_path / "s.usdc"))
    prim = stage.GetPrimAtPath("/surfels/field")
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)

    def values(name: str) -> np.ndarray:
        return np.array(prim.GetAttribute(name).Get())

    np.testing.assert_array_equal(values("positions"), some.means)
    np.testing.assert_array_equal(values("scales")[:, :2], some.scales)
    assert not values("scales")[:, 2].any()
    np.testing.assert_array_equal(values("opacities"), some.opacities)  # linear, not logits
    first = prim.GetAttribute("orientations").Get()[0]
    read = [first.GetReal(), *first.GetImaginary()]
    np.testing.assert_allclose(read, some.quats[0], atol=1e-7)
    shown = values("radiance:sphericalHarmonicsCoefficients") * 0.28209479 + 0.5
    np.testing.assert_allclose(linear_from_srgb(shown), some.values["diffuse"], atol=1e-4)


def test_what_photos_saw_is_a_grey_picture_beside_the_textures(tmp_path: Path) -> None:
    mesh = textured(64)
    mesh.confidence[:32] = 0
    mesh.confidence[40] = 1  # seen, if hardly: not the zero of what nobody saw
    made = product(mesh, up=np.array([0.0, 0.0, 1.0]), metres_per_unit=0.1)
    files.textures(tmp_path, made)
    found = cv2.imread(str(tmp_path / "textures" / "confidence.png"), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint8 and found.shape == (64, 64)
    np.testing.assert_array_equal(found == 0, mesh.confidence == 0)
    assert (found[40] == 1).all() and (found[41:] == 255).all()
    files.glb(tmp_path, made)
    assert b"confidence" not in (tmp_path / "asset.glb").read_bytes()


def test_coverage_shows_what_no_photo_saw_and_the_inside_behind_a_hole() -> None:
    mesh = textured(64)
    made = product(mesh, up=np.array([0.0, 0.0, 1.0]), metres_per_unit=0.1)

    def shares(shown: Product) -> list[float]:
        pixels = render_coverage(shown, count=1, side=64)[0]
        color = pixels[pixels[..., 3] == 255][:, :3].astype(float)
        hue = color / np.linalg.norm(color, axis=1, keepdims=True)
        known = np.stack([MUCH, UNSEEN, INSIDE])
        known /= np.linalg.norm(known, axis=1, keepdims=True)
        return [float(share) for share in np.bincount((hue @ known.T).argmax(1), minlength=3)]

    whole = shares(made)
    assert whole[1:] == [0, 0]
    unseen = np.zeros_like(made.confidence)
    assert shares(replace(made, confidence=unseen))[1] == whole[0]
    front = made.vertices[made.faces].mean(1)[:, 2] > 0.05
    holed = shares(replace(made, faces=made.faces[~front]))
    assert holed[2] > 0.3 * whole[0] and holed[0] > 0


def test_a_textured_mesh_survives_the_round_trip(tmp_path: Path) -> None:
    mesh = textured(64)
    mesh.save(tmp_path)
    again = TexturedMesh.load(tmp_path)
    for name in ("base_color", "roughness", "metallic", "normal", "confidence", "tangents"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    for name in ("vertices", "normals", "uv", "faces"):
        np.testing.assert_array_equal(getattr(again.mesh, name), getattr(mesh.mesh, name))
    (tmp_path / "normal.png").write_bytes(b"")
    with pytest.raises(CorruptError, match="normal"):
        TexturedMesh.load(tmp_path)


def test_textures_must_be_square_powers_of_two_and_agree() -> None:
    made = textured(64)
    fields = {name: getattr(made, name) for name in TexturedMesh.__dataclass_fields__}
    with pytest.raises(ShapeError, match="48 texels wide"):
        TexturedMesh(**{**fields, "base_color": np.zeros((48, 48, 3), np.uint16)})
    with pytest.raises(ShapeError, match="roughness is"):
        TexturedMesh(**{**fields, "roughness": np.zeros((32, 32), np.uint16)})
    with pytest.raises(ShapeError, match="tangents"):
        TexturedMesh(**{**fields, "tangents": np.zeros((3, 4), np.float32)})


def test_an_asset_lists_and_hashes_its_files(folder: Path, tmp_path: Path) -> None:
    asset = Asset.of(folder, faces=10, texture_size=256)
    asset.save(tmp_path)
    again = Asset.load(tmp_path)
    assert again.files == asset.files and (again.faces, again.texture_size) == (10, 256)
    names = {file.name for file in asset.files}
    assert {"asset.glb", "asset.usdz", "textures/normal.png", "preview.png"} <= names
    assert Asset.of(tmp_path, faces=10, texture_size=256).files == asset.files
    (tmp_path / "asset.json").write_text("{}")
    with pytest.raises(CorruptError, match=r"asset\.json"):
        Asset.load(tmp_path)


def test_the_same_product_gives_the_same_bytes(folder: Path, ball: Product, tmp_path: Path) -> None:
    for write in files.writers(preview=96):
        write(tmp_path, ball)
    first = Asset.of(folder, faces=1, texture_size=1).files
    assert Asset.of(tmp_path, faces=1, texture_size=1).files == first


def test_orbit_cameras_see_the_origin() -> None:
    for camera in orbit(5):
        uv, depth = camera.project(np.zeros((1, 3)))
        np.testing.assert_allclose(uv, [[80, 80]], atol=1e-9)
        assert depth > 0
