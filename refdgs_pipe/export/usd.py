"""USD: a binary stage (USDC) beside its textures, and all of it in one USDZ for AR."""

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.about import About
from refdgs_pipe.export.product import Product


def write_usdc(
    path: Path,
    product: Product,
    *,
    textures: str,
    comment: str,
    base_color: str = "base_color.jpg",
    extend: Callable[[Any, Any], None] | None = None,
) -> None:
    """Write the product as a USDC.

    Args:
        textures: the folder of the pictures seen from there; base_color: the file of that one.
        extend: gets the stage and the material before they are saved.
    """
    from pxr import Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetMetadata("comment", comment)
    root = UsdGeom.Xform.Define(stage, "/object")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    root.GetPrim().SetCustomDataByKey("refdgs", usd_data(product.about))

    mesh = UsdGeom.Mesh.Define(stage, "/object/mesh")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(product.vertices))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(product.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(product.faces.reshape(-1)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(product.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(product.is_open)
    corners = np.stack([product.vertices.min(0), product.vertices.max(0)])
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    # USD has v upwards.
    st = np.stack([product.uv[:, 0], 1 - product.uv[:, 1]], 1).astype(np.float32)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    primvar.Set(Vt.Vec2fArray.FromNumpy(st))
    material = _material(stage, textures, base_color, has_metal=product.has_metal)
    if extend is not None:
        extend(stage, material)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def usd_data(about: About) -> dict[str, Any]:
    """Metadata as USD keeps it: texts, numbers and lists of texts."""
    from pxr import Vt

    return {k: Vt.StringArray(list(v)) if isinstance(v, list) else v for k, v in about.items()}


def write_usdz(path: Path, usdc: Path, textures: list[Path]) -> None:
    """Pack a USDC and its textures, which lie in folders beside it, as one USDZ.

    USD's own packer stamps the time into the file; this one gives equal bytes for equal content.

    Raises:
        ExportError: one of them is missing.
    """
    try:
        with path.open("wb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as package:
            for file in (usdc, *textures):  # the layer must be first
                entry = zipfile.ZipInfo(file.relative_to(usdc.parent).as_posix())
                entry.extra = _padding(out.tell() + 30 + len(entry.filename))
                package.writestr(entry, file.read_bytes())
    except FileNotFoundError as error:
        path.unlink(missing_ok=True)
        raise ExportError(f"{path.name}: cannot be packed; {error.filename} is missing") from error


def _padding(offset: int) -> bytes:
    """A zip extra field after which the data starts at a multiple of 64 bytes."""
    size = -(offset + 4) % 64
    return struct.pack("<HH", 0x1986, size) + b"\0" * size


def _material(stage: Any, textures: str, base_color: str, *, has_metal: bool) -> Any:
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/object/material")
    reader = UsdShade.Shader.Define(stage, "/object/material/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    st = reader.CreateOutput("result", types.Float2)
    surface = UsdShade.Shader.Define(stage, "/object/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(0)

    def texture(name: str, file: str, space: str, output: str, kind: Any) -> Any:
        shader = UsdShade.Shader.Define(stage, f"/object/material/{name}")
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"{textures}/{file}"))
        shader.CreateInput("sourceColorSpace", types.Token).Set(space)
        for wrap in ("wrapS", "wrapT"):
            shader.CreateInput(wrap, types.Token).Set("clamp")
        shader.CreateInput("st", types.Float2).ConnectToSource(st)
        if name == "normal":
            shader.CreateInput("scale", types.Float4).Set((2, 2, 2, 1))
            shader.CreateInput("bias", types.Float4).Set((-1, -1, -1, 0))
        return shader.CreateOutput(output, kind)

    color = texture("base_color", base_color, "sRGB", "rgb", types.Float3)
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(color)
    # Old Quick Look wants grey pictures of their own, not channels of one.
    rough = texture("roughness", "roughness.png", "raw", "r", types.Float)
    surface.CreateInput("roughness", types.Float).ConnectToSource(rough)
    metallic = surface.CreateInput("metallic", types.Float)
    if has_metal:
        metal = texture("metallic", "metallic.png", "raw", "r", types.Float)
        metallic.ConnectToSource(metal)
    else:
        metallic.Set(0.0)
    occlusion = texture("occlusion", "occlusion.png", "raw", "r", types.Float)
    surface.CreateInput("occlusion", types.Float).ConnectToSource(occlusion)
    normal = texture("normal", "normal.png", "raw", "rgb", types.Float3)
    surface.CreateInput("normal", types.Normal3f).ConnectToSource(normal)
    output = surface.CreateOutput("surface", types.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    return material
