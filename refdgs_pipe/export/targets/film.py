"""For film and offline rendering: USD with OpenPBR, and every bit of the textures."""

from functools import partial
from pathlib import Path
from typing import Any

from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.export import files
from refdgs_pipe.export.about import GENERATOR
from refdgs_pipe.export.targets.order import Made, Order
from refdgs_pipe.export.usd import write_usdc
from refdgs_pipe.export.validate import require, usd_faults
from refdgs_pipe.files.images import write_png

_TEXTURES = "textures"
_VERSION = "1.39"  # of MaterialX, the first that has OpenPBR
_KINDS = {"color3": "Color3f", "float": "Float", "vector3": "Float3"}  # MaterialX -> USD


def film(order: Order, folder: Path) -> Made:
    """asset.usdc with UsdPreviewSurface and OpenPBR, 16-bit textures, and scene.usda around it.

    Raises:
        ExportError: a file did not pass its check.
    """
    product = order.product
    _write_textures(folder / _TEXTURES, order.textured)
    path = folder / "asset.usdc"
    write_usdc(
        path,
        product,
        textures=_TEXTURES,
        comment=GENERATOR,
        base_color="base_color.png",
        extend=partial(add_open_pbr, textures=_TEXTURES, has_metal=product.has_metal),
    )
    require(path, usd_faults(path))
    files.scene(order.around, folder, product)
    figures: dict[str, float | int | str] = {
        "triangles": len(product.faces),
        "texture_size": order.textured.size,
        "texture_bits": 16,
        "materialx": _VERSION,
    }
    summary = f"{len(product.faces)} triangles, OpenPBR and UsdPreviewSurface, 16-bit textures of "
    return Made(f"{summary}{order.textured.size} texels", figures)


def _write_textures(folder: Path, textured: TexturedMesh) -> None:
    for name in ("base_color", "roughness", "metallic", "occlusion", "normal"):
        write_png(folder / f"{name}.png", getattr(textured, name))


def add_open_pbr(stage: Any, material: Any, *, textures: str, has_metal: bool) -> None:
    """Give a material OpenPBR too, for renderers that read MaterialX (outputs:mtlx:surface).

    Args:
        textures: the folder of the pictures, seen from the stage's file.
    """
    from pxr import Sdf

    types, root = Sdf.ValueTypeNames, material.GetPath()
    prim = material.GetPrim()
    prim.AddAppliedSchema("MaterialXConfigAPI")
    prim.CreateAttribute("config:mtlx:version", types.String, False).Set(_VERSION)
    surface = _shader(stage, root.AppendChild("open_pbr"), "ND_open_pbr_surface_surfaceshader")
    st = _shader(stage, root.AppendChild("mtlx_st"), "ND_geompropvalue_vector2")
    st.CreateInput("geomprop", types.String).Set("st")
    place = st.CreateOutput("out", types.Float2)

    def picture(name: str, kind: str, space: str | None = None) -> Any:
        node = _shader(stage, root.AppendChild(f"mtlx_{name}"), f"ND_image_{kind}")
        file = node.CreateInput("file", types.Asset)
        file.Set(Sdf.AssetPath(f"{textures}/{name}.png"))
        if space:
            file.GetAttr().SetColorSpace(space)
        for mode in ("uaddressmode", "vaddressmode"):
            node.CreateInput(mode, types.String).Set("clamp")
        node.CreateInput("texcoord", types.Float2).ConnectToSource(place)
        return node.CreateOutput("out", getattr(types, _KINDS[kind]))

    color = picture("base_color", "color3", "srgb_texture")
    surface.CreateInput("base_color", types.Color3f).ConnectToSource(color)
    surface.CreateInput("base_weight", types.Float).Set(1.0)
    metal = surface.CreateInput("base_metalness", types.Float)
    if has_metal:
        metal.ConnectToSource(picture("metallic", "float"))
    else:
        metal.Set(0.0)
    rough = surface.CreateInput("specular_roughness", types.Float)
    rough.ConnectToSource(picture("roughness", "float"))
    bent = _shader(stage, root.AppendChild("mtlx_bent"), "ND_normalmap_float")
    bent.CreateInput("in", types.Float3).ConnectToSource(picture("normal", "vector3"))
    normal = surface.CreateInput("geometry_normal", types.Float3)
    normal.ConnectToSource(bent.CreateOutput("out", types.Float3))
    output = surface.CreateOutput("out", types.Token)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(output)


def _shader(stage: Any, path: Any, kind: str) -> Any:
    from pxr import UsdShade

    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader
