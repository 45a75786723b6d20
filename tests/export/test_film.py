"""The target film: OpenPBR beside UsdPreviewSurface, and every bit of the textures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orders import dented, order_in

from refdgs_pipe.artifacts.asset import Delivery
from refdgs_pipe.export.targets.delivering import deliver
from refdgs_pipe.export.targets.order import Order
from refdgs_pipe.export.validate import usd_faults
from refdgs_pipe.files.images import read_png


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    return order_in(tmp_path_factory.mktemp("asset"), dented(12, 64))


@pytest.fixture(scope="module")
def film(order: Order) -> Delivery:
    return deliver("film", order, pytest.fail)


@pytest.fixture(scope="module")
def shaders(order: Order, film: Delivery) -> dict[str, Any]:
    """Name -> shader of asset.usdc."""
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(order.folder / "targets/film/asset.usdc"))
    found = {p.GetName(): UsdShade.Shader(p) for p in stage.Traverse() if p.IsA(UsdShade.Shader)}
    return {"stage": stage} | found


def test_usd_validation_finds_nothing_in_the_files_for_film(order: Order, film: Delivery) -> None:
    for name in ("asset.usdc", "scene.usda"):
        assert usd_faults(order.folder / "targets/film" / name) == []


def test_the_material_has_openpbr_and_the_preview_surface(shaders: dict[str, Any]) -> None:
    from pxr import UsdShade

    material = UsdShade.Material(shaders["stage"].GetPrimAtPath("/object/material"))
    kinds = {}
    for context in ("mtlx", ""):
        surface, *_ = material.ComputeSurfaceSource(context)
        kinds[context] = surface.GetIdAttr().Get()
    assert kinds == {"mtlx": "ND_open_pbr_surface_surfaceshader", "": "UsdPreviewSurface"}


def test_openpbr_reads_the_same_pictures_as_the_preview_surface(shaders: dict[str, Any]) -> None:
    for name in ("base_color", "roughness", "metallic", "normal"):
        pair = [shaders[key].GetInput("file").Get() for key in (name, f"mtlx_{name}")]
        assert pair[0].path == pair[1].path == f"textures/{name}.png" and pair[1].resolvedPath
    color = shaders["mtlx_base_color"].GetInput("file").GetAttr()
    assert color.GetColorSpace() == "srgb_texture"  # data has none: it is never converted
    assert not shaders["mtlx_roughness"].GetInput("file").GetAttr().GetColorSpace()


def test_textures_for_film_have_the_bits_of_the_bake(order: Order, film: Delivery) -> None:
    for name in ("base_color", "roughness", "normal"):
        read = read_png(order.folder / f"targets/film/textures/{name}.png")
        np.testing.assert_array_equal(read, getattr(order.textured, name))
        assert read.dtype == np.uint16


def test_materialx_knows_every_node_and_input(shaders: dict[str, Any]) -> None:
    mx = pytest.importorskip("MaterialX", reason="MaterialX is not installed")
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    kinds = {"color3f": "color3", "float": "float", "float2": "vector2", "float3": "vector3"}
    kinds |= {"string": "string", "asset": "filename", "token": "surfaceshader"}
    seen = 0
    for name, shader in shaders.items():
        if not (name == "open_pbr" or name.startswith("mtlx_")):
            continue
        node = library.getNodeDef(shader.GetIdAttr().Get())
        assert node is not None, name
        for port in (*shader.GetInputs(), *shader.GetOutputs()):
            wanted = node.getActiveInput(port.GetBaseName()) or node.getActiveOutput(
                port.GetBaseName()
            )
            assert wanted is not None, (name, port.GetBaseName())
            assert wanted.getType() == kinds[str(port.GetTypeName())], (name, port.GetBaseName())
        seen += 1
    assert seen == 7


def test_a_shader_that_does_not_exist_is_still_found_out(tmp_path: Path) -> None:
    from pxr import Usd

    order = order_in(tmp_path, dented(12, 64))
    deliver("film", order, pytest.fail)
    path = tmp_path / "targets/film/asset.usdc"
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath("/object/material/surface").GetAttribute("info:id").Set("UsdPreviewFoo")
    stage.GetRootLayer().Save()
    assert any("UsdPreviewFoo" in fault for fault in usd_faults(path))


def test_film_files_with_a_missing_picture_are_not_delivered(order: Order, tmp_path: Path) -> None:
    from refdgs_pipe.export.targets import film as module

    moved = replace(order, folder=tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "write_png", lambda path, pixels: None)
        said: list[str] = []
        assert deliver("film", moved, said.append).files == ()
    assert "asset.usdc did not pass its check" in said[0]
