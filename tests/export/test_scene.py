"""The surroundings: light from the right sides, cameras that see what the photos saw."""

from dataclasses import replace
from pathlib import Path

import cv2
import finished
import numpy as np
import pytest
from scenes import orbit

from refdgs_pipe.artifacts.surfel_field import ShaderModel
from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.frame import AssetFrame, latlong_directions
from refdgs_pipe.export.scene import write_environment, write_scene
from refdgs_pipe.export.usd import write_usdc
from refdgs_pipe.training.environment import mirrored_light

TILTED = np.array([0.6, 0.0, 0.8])  # an up vector of a world that is not z-up
FRAME = AssetFrame.of(TILTED, 0.1)


def shader_of(height: int, lit: np.ndarray) -> ShaderModel:
    """A field's shader whose radiance is exp(2) where the map's texel is lit, else exp(0).

    Args:
        lit: (3,) world direction of the one bright spot.
    """
    v, u = np.meshgrid(
        (np.arange(height) + 0.5) / height,
        (np.arange(2 * height) + 0.5) / (2 * height),
        indexing="ij",
    )
    polar, azimuth = v * np.pi, u * 2 * np.pi  # Sph-Mip: from +z, and from +x towards +y
    towards = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1
    )
    spot = (towards @ lit > np.cos(np.deg2rad(20))).astype(np.float32)
    environment = np.stack([spot, *[np.zeros_like(spot)] * 3], -1)
    first = np.zeros((64, 4), np.float32)
    first[0, 0] = 1
    between = np.zeros((64, 64), np.float32)
    between[0, 0] = 1
    last = np.zeros((3, 64), np.float32)
    last[:, 0] = 2
    zeros = [np.zeros(n, np.float32) for n in (64, 64, 64, 3)]
    layers = (first, between, between, last)
    return ShaderModel(True, "none", "adaptive", False, environment, layers, tuple(zeros))


@pytest.mark.parametrize("lit", [[0, 0, 1], [1, 0, 0], [0, -1, 0], [-0.48, 0.6, 0.64]])
def test_a_bright_spot_is_at_the_pixel_of_its_direction(lit: list[float], tmp_path: Path) -> None:
    """Through the map, the shader, the turn to +Y up and the file."""
    spot = np.array(lit) / np.linalg.norm(lit)
    field = replace(finished.field(), shader=shader_of(64, spot))
    light = mirrored_light(field, FRAME.to_world(latlong_directions(64)).astype(np.float32))
    assert light is not None
    write_environment(tmp_path, light)
    picture = cv2.imread(str(tmp_path / "environment.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert picture.shape == (64, 128, 3)
    np.testing.assert_allclose(np.unique(picture)[[0, -1]], [1, np.exp(2)], rtol=0.01)
    x, y, z = FRAME.directions(spot)
    row = np.arccos(np.clip(y, -1, 1)) / np.pi * 64
    column = (0.5 - np.arctan2(x, z) / (2 * np.pi)) * 128
    assert picture[int(min(row, 63)), int(column) % 128].min() > 7
    angles = np.degrees(np.arccos(np.clip(latlong_directions(64) @ np.array([x, y, z]), -1, 1)))
    assert (picture[angles < 15] > 7).all() and (picture[angles > 25] < 1.01).all()


def test_the_latlong_layout_is_that_of_openexr_and_usd() -> None:
    towards = latlong_directions(256)
    np.testing.assert_allclose(towards[0].mean(0), [0, 1, 0], atol=0.01)
    for column, direction in (
        (256, [0, 0, 1]),
        (128, [1, 0, 0]),
        (384, [-1, 0, 0]),
        (0, [0, 0, -1]),
    ):
        np.testing.assert_allclose(towards[128, column], direction, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=-1), 1)


def test_a_matte_field_has_no_light_and_a_broken_one_is_not_written(tmp_path: Path) -> None:
    field = finished.field()
    matte = replace(field, shader=replace(field.shader, reflection=False))
    assert mirrored_light(matte, np.zeros((2, 4, 3), np.float32)) is None
    with pytest.raises(ExportError, match="not finite"):
        write_environment(tmp_path, np.full((2, 4, 3), np.nan, np.float32))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    from refdgs_pipe.export.files import textures
    from refdgs_pipe.export.product import product

    made = product(finished.textured(64), up=TILTED, metres_per_unit=0.1)
    textures(tmp_path, made)
    write_usdc(tmp_path / "asset.usdc", made, textures="textures", comment="")
    write_environment(tmp_path, np.ones((8, 16, 3), np.float32))
    return tmp_path


def test_cameras_in_usd_project_points_to_the_same_pixels(folder: Path) -> None:
    from pxr import Usd, UsdGeom

    cameras = orbit(3, size=160)
    K = np.array([[210.0, 0, 71.0], [0, 190.0, 90.5], [0, 0, 1]])  # off centre, pixels not square
    cameras = [replace(camera, K=K, height=120) for camera in cameras]
    cameras[1] = replace(cameras[1], name="7 up/ä.jpg")  # no identifier
    write_scene(folder, cameras, FRAME, {})
    stage = Usd.Stage.Open(str(folder / "scene.usda"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    points = np.random.default_rng(3).normal(size=(20, 3)) * 0.3
    prims = stage.GetPrimAtPath("/scene/cameras").GetChildren()
    assert len(prims) == 3
    for prim, camera in zip(prims, cameras, strict=True):
        seen = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default())
        to_clip = np.array(seen.frustum.ComputeViewMatrix()) @ np.array(
            seen.frustum.ComputeProjectionMatrix()
        )
        clip = np.concatenate([FRAME.points(points), np.ones((20, 1))], 1) @ to_clip
        ndc = clip[:, :2] / clip[:, 3:]
        pixels = np.stack([(ndc[:, 0] + 1) / 2 * 160, (1 - ndc[:, 1]) / 2 * 120], 1)
        np.testing.assert_allclose(pixels, camera.project(points)[0], atol=1e-3)


def test_the_scene_holds_the_asset_in_its_light(folder: Path) -> None:
    from pxr import Usd, UsdGeom, UsdLux

    write_scene(folder, orbit(2), FRAME, {"recipe": "glossy"})
    stage = Usd.Stage.Open(str(folder / "scene.usda"))
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/scene/object/mesh")).GetPointsAttr().Get()
    light = UsdLux.DomeLight(stage.GetPrimAtPath("/scene/environment"))
    assert Path(light.GetTextureFileAttr().Get().resolvedPath).samefile(folder / "environment.hdr")
    assert stage.GetDefaultPrim().GetCustomDataByKey("refdgs")["recipe"] == "glossy"
    del light, stage  # USD keeps open layers by their names
    (folder / "environment.hdr").unlink()
    write_scene(folder, orbit(2), FRAME, {})
    assert not Usd.Stage.Open(str(folder / "scene.usda")).GetPrimAtPath("/scene/environment")
