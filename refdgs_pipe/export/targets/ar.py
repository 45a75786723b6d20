"""For augmented reality: USDZ for Quick Look, GLB for Scene Viewer."""

import tempfile
from pathlib import Path

from refdgs_pipe.export import files
from refdgs_pipe.export.product import Product
from refdgs_pipe.export.targets.order import Made, Order, with_textures

TRIANGLES, TEXTURE = 100_000, 2048
GLB_BYTES = 15_000_000
_LEAST_TEXTURE = 256


def ar(order: Order, folder: Path) -> Made:
    """asset.usdz and asset.glb within the limits of phones.

    Raises:
        ExportError: a file did not pass its check.
    """
    product = with_textures(order.coarse(TRIANGLES).product, TEXTURE)
    _write_usdz(folder, product)
    light = product
    files.glb(folder, light)
    path, side = folder / "asset.glb", len(product.base_color)
    while path.stat().st_size > GLB_BYTES and side > _LEAST_TEXTURE:
        side //= 2
        light = with_textures(product, side)
        files.glb(folder, light)
    size = path.stat().st_size
    figures: dict[str, float | int | str] = {
        "triangles": len(product.faces),
        "texture_size": len(product.base_color),
        "usdz_bytes": (folder / "asset.usdz").stat().st_size,
        "glb_texture_size": len(light.base_color),
        "glb_bytes": size,
    }
    warnings: tuple[str, ...] = ()
    if size > GLB_BYTES:
        warnings = (
            f"target ar: asset.glb has {size / 1e6:.0f} MB; Scene Viewer takes up to "
            f"{GLB_BYTES // 10**6} MB. Lower clean.faces",
        )
    summary = f"{len(product.faces)} triangles, textures of {len(product.base_color)} texels"
    return Made(summary, figures, _size_note(order), warnings)


def _size_note(order: Order) -> tuple[str, ...]:
    """AR shows things at their true size, so it must be known."""
    return () if order.is_size_known else (f"its size is {order.size}",)


def _write_usdz(folder: Path, product: Product) -> None:
    with tempfile.TemporaryDirectory(dir=folder) as place:
        inside = Path(place)
        files.textures(inside, product)
        files.usdc(inside, product)
        files.usdz(inside, product)
        (inside / "asset.usdz").replace(folder / "asset.usdz")
