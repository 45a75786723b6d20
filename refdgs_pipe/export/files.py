"""Which files make an asset, in what order, and the check that each must pass."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surfel_field import SurfelSet
from refdgs_pipe.camera import Camera
from refdgs_pipe.export.about import GENERATOR
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.gltf import write_glb
from refdgs_pipe.export.obj import write_obj
from refdgs_pipe.export.preview import render_preview
from refdgs_pipe.export.product import Product, jpeg, png
from refdgs_pipe.export.scene import write_environment, write_scene
from refdgs_pipe.export.splats import in_asset_frame, write_particle_field, write_splats
from refdgs_pipe.export.usd import write_usdc, write_usdz
from refdgs_pipe.export.validate import glb_faults, require, usd_faults

Write: TypeAlias = Callable[[Path, Product], None]

_TEXTURES = "textures"


@dataclass(frozen=True)
class Surroundings:
    """What is not in the mesh, in the world's frame but for the light.

    Args:
        frame: how the world becomes the asset.
        light: (H, 2H, 3) linear, as `latlong_directions` says; None for a matte field.
        surfels: with diffuse colours.
    """

    frame: AssetFrame
    light: NDArray[np.float32] | None
    cameras: Sequence[Camera]
    surfels: SurfelSet


def writers(around: Surroundings | None = None, *, preview: int) -> list[Write]:
    """The functions that each write and check one file; they build on each other in this order.

    Args:
        around: written too, if given.
        preview: side of each picture of the preview, pixels.
    """

    def picture(folder: Path, product: Product) -> None:
        (folder / "preview.png").write_bytes(png(render_preview(product, side=preview)))

    mesh: list[Write] = [textures, glb, usdc, usdz, obj, picture]
    if around is None:
        return mesh
    return [*mesh, partial(splats, around), partial(scene, around)]


def textures(folder: Path, product: Product) -> None:
    """The pictures that USDC and OBJ refer to, and how certain the shape is at each texel."""
    (folder / _TEXTURES).mkdir(exist_ok=True)
    for name, content in (
        ("base_color.jpg", jpeg(product.base_color)),
        ("roughness.png", png(product.roughness)),
        ("metallic.png", png(product.metallic)),
        ("occlusion.png", png(product.occlusion)),
        ("normal.png", png(product.normal)),
        ("confidence.png", png(product.confidence)),
    ):
        (folder / _TEXTURES / name).write_bytes(content)


def glb(folder: Path, product: Product, *, name: str = "asset.glb") -> None:
    """asset.glb, or one of its coarser versions by another name.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / name
    write_glb(path, product, generator=GENERATOR)
    require(path, glb_faults(path))


def usdc(folder: Path, product: Product) -> None:
    """asset.usdc beside its textures.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / "asset.usdc"
    write_usdc(path, product, textures=_TEXTURES, comment=GENERATOR)
    require(path, usd_faults(path))


def usdz(folder: Path, product: Product) -> None:
    """asset.usdz, from the USDC that is there.

    Raises:
        ExportError: it did not pass its check.
    """
    path = folder / "asset.usdz"
    names = ["base_color.jpg", "roughness.png", "occlusion.png", "normal.png"]
    names += ["metallic.png"] if product.has_metal else []
    write_usdz(path, folder / "asset.usdc", [folder / _TEXTURES / name for name in names])
    require(path, usd_faults(path))


def splats(around: Surroundings, folder: Path, product: Product) -> None:
    """splats.ply and, where this USD knows particle fields, splats.usdc.

    Raises:
        ExportError: the latter did not pass its check.
    """
    turned = in_asset_frame(around.surfels, around.frame)
    write_splats(folder / "splats.ply", turned)
    path = folder / "splats.usdc"
    if write_particle_field(path, turned, product.about):
        require(path, usd_faults(path))


def scene(around: Surroundings, folder: Path, product: Product) -> None:
    """environment.hdr and scene.usda, over the USDC that is there.

    Raises:
        ExportError: one of them did not pass its check.
    """
    if around.light is not None:
        write_environment(folder, around.light)
    write_scene(folder, around.cameras, around.frame, product.about)


def obj(folder: Path, product: Product) -> None:
    """asset.obj and asset.mtl."""
    write_obj(folder / "asset.obj", product, textures=_TEXTURES)
