"""For web pages: a fifth of asset.glb or less, in any viewer of glTF 2.0 of today."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.about import GENERATOR
from refdgs_pipe.export.glb_reading import read_glb
from refdgs_pipe.export.gltf import INDICES, VERTICES, Chunk, document_of, save_glb
from refdgs_pipe.export.product import Product
from refdgs_pipe.export.targets import packing
from refdgs_pipe.export.targets.difference import studio_psnr
from refdgs_pipe.export.targets.order import Made, Order, with_textures
from refdgs_pipe.export.validate import glb_faults, require

LARGEST_SHARE = 0.2  # of asset.glb
LARGEST_LOSS = 0.5  # dB against the photos
_TRIANGLES = (15_000, 12_000, 9_000, 7_000, 5_000, 3_500, 2_500)
_QUALITIES = (92, 85, 75)  # of WebP
_TEXTURE = 2048
_USED = ("KHR_mesh_quantization", "EXT_texture_webp")


@dataclass(frozen=True)
class _Version:
    """A version that could be delivered.

    Args:
        images: base colour; occlusion, roughness and metal; normals: WebP of that quality.
    """

    product: Product
    quality: int
    images: tuple[bytes, ...]
    bytes: int


def web(order: Order, folder: Path) -> Made:
    """asset.glb, quantised with WebP textures, and asset_meshopt.glb if a packer is installed.

    The most triangles and the best quality that fit; where not even 15 000 triangles fit, the
    version that looks most like the asset in the preview's studio.

    Raises:
        ExportError: the file did not pass its check.
    """
    path, most = folder / "asset.glb", (order.folder / "asset.glb").stat().st_size * LARGEST_SHARE
    chosen = _chosen(order, path, int(most))
    _write(path, chosen.product, chosen.images)
    require(path, glb_faults(path))
    shown = read_glb(path, like=chosen.product)
    size = path.stat().st_size
    figures: dict[str, float | int | str] = {
        "triangles": len(shown.faces),
        "texture_size": len(shown.base_color),
        "webp_quality": chosen.quality,
        "bytes": size,
        "share_of_asset_glb": round(size / (most / LARGEST_SHARE), 3),
        "psnr_to_asset_db": round(studio_psnr(shown, order.product), 1),
    }
    share, warnings = round(100 * size / most * LARGEST_SHARE), []
    summary = f"{len(shown.faces)} triangles, {share} % of asset.glb"
    if size > most:
        warnings.append(
            f"target web: {share} % of asset.glb, not {100 * LARGEST_SHARE:.0f} %: asset.glb is "
            "small already, and less would show"
        )
    if order.loss is not None:
        figures["loss_db"] = loss = round(order.loss(shown), 2)
        summary += f", {loss} dB worse than it against the photos"
        if loss > LARGEST_LOSS:
            warnings.append(
                f"target web: {loss} dB worse than asset.glb against the photos, more than "
                f"{LARGEST_LOSS}: look at it, or use asset.glb"
            )
    more, note = _packed(path, folder / "asset_meshopt.glb")
    return Made(summary, figures | more, (note,), tuple(warnings))


def _chosen(order: Order, path: Path, most: int) -> _Version:
    """The version to deliver; see `web`."""
    versions: list[_Version] = []
    pictures = [_pictures(with_textures(order.product, _TEXTURE), q) for q in _QUALITIES]
    faces = len(order.product.faces)
    for budget in (_TRIANGLES[0], *(n for n in _TRIANGLES[1:] if n < faces)):
        product = with_textures(order.coarse(budget).product, _TEXTURE)
        for quality, images in zip(_QUALITIES, pictures, strict=True):
            _write(path, product, images)
            version = _Version(product, quality, images, path.stat().st_size)
            if version.bytes <= most:
                break
        versions.append(version)
        if len(versions) == 1 and version.quality == _QUALITIES[0]:
            return version
    fitting = [version for version in versions if version.bytes <= most]
    return max(fitting, key=lambda v: _likeness(v, order, path)) if fitting else versions[-1]


def _likeness(version: _Version, order: Order, path: Path) -> float:
    _write(path, version.product, version.images)
    return studio_psnr(read_glb(path, like=version.product), order.product)


def _pictures(product: Product, quality: int) -> tuple[bytes, ...]:
    """Base colour; occlusion, roughness and metal; normals: as WebP."""
    packed = np.stack([product.occlusion, product.roughness, product.metallic], -1)
    return tuple(webp(p, quality) for p in (product.base_color, packed, product.normal))


def _write(path: Path, product: Product, pictures: tuple[bytes, ...]) -> None:
    """A GLB with whole numbers for its vertices and WebP for its pictures."""
    chunk = Chunk()
    low = product.vertices.min(0)
    scale = float(np.ptp(product.vertices, axis=0).max()) or 1.0
    attributes = {
        "POSITION": chunk.accessor(
            _whole((product.vertices - low) / np.float32(scale), np.uint16),
            *("VEC3", VERTICES),
            bounds=True,
            normalized=True,
        ),
        "NORMAL": chunk.accessor(
            _whole(product.normals, np.int8), "VEC3", VERTICES, normalized=True
        ),
        "TANGENT": chunk.accessor(
            _whole(product.tangents, np.int8), "VEC4", VERTICES, normalized=True
        ),
        "TEXCOORD_0": chunk.accessor(
            _whole(product.uv, np.uint16), "VEC2", VERTICES, normalized=True
        ),
    }
    kind = np.uint16 if len(product.vertices) < 65535 else np.uint32
    faces = chunk.accessor(product.faces.reshape(-1).astype(kind), "SCALAR", INDICES)
    names = ("base_color", "occlusion_roughness_metallic", "normal")
    images = [chunk.image(*pair, "image/webp") for pair in zip(names, pictures, strict=True)]
    primitive = {"attributes": attributes, "indices": faces, "material": 0, "mode": 4}
    document: dict[str, Any] = document_of(product, chunk, primitive, images, generator=GENERATOR)
    document["extensionsUsed"] = document["extensionsRequired"] = list(_USED)
    document["nodes"][0] |= {"translation": low.tolist(), "scale": [scale] * 3}
    for texture in document["textures"]:
        texture["extensions"] = {"EXT_texture_webp": {"source": texture.pop("source")}}
    save_glb(path, document, chunk)


def _whole(values: NDArray[np.float32], kind: type[Any]) -> NDArray[Any]:
    """Fractions as whole numbers of a type, its largest for 1."""
    limits = np.iinfo(kind)
    scaled = np.round(values.astype(np.float64) * limits.max)
    return np.clip(scaled, -limits.max if limits.min else 0, limits.max).astype(kind)


def webp(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """A picture (H, W, 3) as WebP."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", quality=quality, method=6)
    return file.getvalue()


def _packed(source: Path, target: Path) -> tuple[dict[str, float | int | str], str]:
    """Figures of the packed file, and what to know of it, or why there is none."""
    if (packer := packing.found()) is None:
        return {}, packing.NONE_FOUND
    try:
        tool = packing.packed(*packer, source, target)
    except ExportError as error:
        return {}, f"no file packed with meshopt: {error}"
    return {"meshopt_bytes": target.stat().st_size, "meshopt_by": tool}, (
        "asset_meshopt.glb needs a viewer with the meshopt decoder (three.js and model-viewer "
        "load it when told where it is)"
    )
