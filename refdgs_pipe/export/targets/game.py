"""For game engines: levels of detail, and packed textures."""

from pathlib import Path

import numpy as np

from refdgs_pipe.export import files
from refdgs_pipe.export.product import Product, jpeg, png
from refdgs_pipe.export.targets.order import Made, Order

TRIANGLES = (50_000, 15_000, 5_000)


def game(order: Order, folder: Path) -> Made:
    """asset_lod0.glb and coarser ones on the same textures, and these textures as files.

    A level is left out where the mesh has no more triangles than the level before.

    Raises:
        ExportError: a file did not pass its check.
    """
    figures: dict[str, float | int | str] = {}
    faces = len(order.product.faces)
    levels = [order.coarse(budget) for budget in (TRIANGLES[0], *_below(faces))]
    for number, level in enumerate(levels):
        name = f"asset_lod{number}.glb"
        files.glb(folder, level.product, name=name)
        figures[f"lod{number}_triangles"] = len(level.product.faces)
        figures[f"lod{number}_off_mean_percent"] = round(level.mean, 4)
        figures[f"lod{number}_off_95_percent"] = round(level.percentile_95, 4)
        figures[f"lod{number}_bytes"] = (folder / name).stat().st_size
    figures["texture_size"] = len(order.product.base_color)
    _write_textures(folder / "textures", order.product)
    counts = ", ".join(str(len(level.product.faces)) for level in levels)
    off = max(level.percentile_95 for level in levels)
    summary = f"levels of {counts} triangles; 95 % of the surface off by at most {off:.2g} % of the"
    notes = () if len(levels) > 1 else (f"one level: the mesh has only {faces} triangles",)
    return Made(f"{summary} diagonal", figures, notes)


def _below(faces: int) -> list[int]:
    """Budgets of the coarser levels that a mesh is reduced to."""
    return [budget for budget in TRIANGLES[1:] if budget < faces]


def _write_textures(folder: Path, product: Product) -> None:
    """Base colour; normals, green up; occlusion, roughness and metal in red, green and blue."""
    folder.mkdir()
    packed = np.stack([product.occlusion, product.roughness, product.metallic], -1)
    (folder / "base_color.jpg").write_bytes(jpeg(product.base_color))
    (folder / "occlusion_roughness_metallic.png").write_bytes(png(packed))
    (folder / "normal.png").write_bytes(png(product.normal))
