"""Which files make an asset, in what order, and the check that each must pass."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from refdgs_pipe import __version__
from refdgs_pipe.export.gltf import write_glb
from refdgs_pipe.export.obj import write_obj
from refdgs_pipe.export.preview import render_preview
from refdgs_pipe.export.product import Product, jpeg, png
from refdgs_pipe.export.usd import write_usdc, write_usdz
from refdgs_pipe.export.validate import glb_faults, require, usd_faults

Write: TypeAlias = Callable[[Path, Product], None]

_GENERATOR = f"refdgs-pipe {__version__}"
_TEXTURES = "textures"


def writers(*, preview: int) -> list[Write]:
    """The functions that each write and check one file; they build on each other in this order.

    Args:
        preview: side of each picture of the preview, pixels.
    """

    def picture(folder: Path, product: Product) -> None:
        (folder / "preview.png").write_bytes(png(render_preview(product, side=preview)))

    return [textures, glb, usdc, usdz, obj, picture]


def textures(folder: Path, product: Product) -> None:
    """The pictures that USDC and OBJ refer to."""
    (folder / _TEXTURES).mkdir(exist_ok=True)
    for name, content in (
        ("base_color.jpg", jpeg(product.base_color)),
        ("roughness.png", png(product.roughness)),
        ("metallic.png", png(product.metallic)),
        ("normal.png", png(product.normal)),
    ):
        (folder / _TEXTURES / name).write_bytes(content)


def glb(folder: Path, product: Product) -> None:
    """asset.glb.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / "asset.glb"
    extras = {"unit": "metre", "normals": "MikkTSpace", "base_color": "free of reflections"}
    write_glb(path, product, generator=_GENERATOR, extras=extras)
    require(path, glb_faults(path))


def usdc(folder: Path, product: Product) -> None:
    """asset.usdc beside its textures.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / "asset.usdc"
    write_usdc(path, product, textures=_TEXTURES, comment=_GENERATOR)
    require(path, usd_faults(path))


def usdz(folder: Path, product: Product) -> None:
    """asset.usdz, from the USDC that is there.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / "asset.usdz"
    names = ["base_color.jpg", "roughness.png", "normal.png"]
    names += ["metallic.png"] if product.has_metal else []
    write_usdz(path, folder / "asset.usdc", [folder / _TEXTURES / name for name in names])
    require(path, usd_faults(path))


def obj(folder: Path, product: Product) -> None:
    """asset.obj and asset.mtl."""
    write_obj(folder / "asset.obj", product, textures=_TEXTURES)
