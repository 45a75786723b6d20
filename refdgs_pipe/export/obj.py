"""Wavefront OBJ and MTL, the plainest of the formats."""

from pathlib import Path

import numpy as np

from refdgs_pipe.export.product import Product


def write_obj(path: Path, product: Product, *, textures: str) -> None:
    """Write PATH and, beside it, its .mtl; `textures` is the folder of the pictures from there."""
    material = path.with_suffix(".mtl")
    lines = [f"# {key}: {_one_line(value)}" for key, value in product.about.items()]
    lines += [f"mtllib {material.name}", "o object"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in product.vertices.tolist()]
    # OBJ has v upwards.
    lines += [f"vt {u:.7g} {1 - v:.7g}" for u, v in product.uv.tolist()]
    lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in product.normals.tolist()]
    lines.append("usemtl surface")
    one_based = (product.faces.astype(np.int64) + 1).tolist()
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in one_based]
    path.write_text("\n".join(lines) + "\n", "utf-8")
    material.write_text(
        "newmtl surface\n"
        "Kd 1 1 1\n"
        "Ks 0 0 0\n"
        "illum 2\n"
        f"map_Kd {textures}/base_color.jpg\n"
        f"map_Pr {textures}/roughness.png\n"
        f"map_Pm {textures}/metallic.png\n"
        f"norm {textures}/normal.png\n"
    )


def _one_line(value: str | float | list[str]) -> str:
    """A value as a comment can hold it."""
    text = ", ".join(value) if isinstance(value, list) else str(value)
    return " ".join(text.splitlines())
