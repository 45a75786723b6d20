"""How much worse a lighter product looks: against the photos, and against the asset itself."""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.preview import cast, rays_around, reach_around, shade
from refdgs_pipe.export.product import Product
from refdgs_pipe.metrics import psnr
from refdgs_pipe.relight import relit
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
_PHOTOS, _SIDE = 6, 400  # photos that are compared with; their longer side at most, pixels
_STUDIO_VIEWS, _STUDIO_SIDE = 4, 256
_BACKDROP = 0.72  # sRGB


def photo_loss(
    textured: TexturedMesh,
    looks: Appearance,
    frame: AssetFrame,
    views: Views,
    model: SparseModel,
) -> Callable[[Product], float] | None:
    """What tells how much worse another product matches the photos; None for a matte field.

    Args:
        textured: the asset, in the world's frame.
        frame: how the world becomes the asset.
        model: with the field's own poses.
    """
    if looks.environment is None:
        return None

    def load(camera: Camera, longest: int) -> Photo:
        return load_photo(views, model, camera, scale=camera.fitted(longest).width / camera.width)

    return PhotoJudge(textured, looks, frame, model.cameras, load).loss


class PhotoJudge:
    """Compares products with photos, each drawn in the light that the asset was told from.

    The PSNR is over the pixels that the asset or the product covers, both over white.

    Args:
        textured: the asset, in the world's frame.
        frame: how the world becomes the asset.
        load: (camera, longer side in pixels) -> photo.
    """

    def __init__(
        self,
        textured: TexturedMesh,
        looks: Appearance,
        frame: AssetFrame,
        cameras: Sequence[Camera],
        load: Callable[[Camera, int], Photo],
    ) -> None:
        self._textured, self._looks, self._frame, self._load = textured, looks, frame, load
        held_out = [c for c in cameras if c.split == "test"] or list(cameras)
        chosen = np.unique(np.linspace(0, len(held_out) - 1, _PHOTOS).astype(int))
        self._cameras = [held_out[i] for i in chosen]

    @cached_property
    def _asset(self) -> list[tuple[Photo, F32, F32]]:
        """Photos, and the asset as each shows it: (H, W, 3) over white, (H, W) coverage."""
        photos = [self._load(camera, _SIDE) for camera in self._cameras]
        drawn = self._drawn(self._textured, [photo.camera for photo in photos])
        return [(photo, *pair) for photo, pair in zip(photos, drawn, strict=True)]

    def _drawn(self, textured: TexturedMesh, cameras: list[Camera]) -> list[tuple[F32, F32]]:
        draw = relit(textured, self._looks)
        assert draw is not None  # who asks has looked for a light
        pairs = []
        for camera in cameras:
            image, alpha = draw(camera)
            over = alpha[..., None]
            pairs.append((np.asarray(image * over + (1 - over), np.float32), alpha))
        return pairs

    def loss(self, product: Product) -> float:
        """How many dB the product's mean PSNR is below the asset's; negative if it is better.

        Raises:
            CorruptError: a photo is damaged.
        """
        asset = self._asset
        textured = in_world(product, self._textured, self._frame)
        lost = []
        cameras = [photo.camera for photo, _, _ in asset]
        for (photo, image, alpha), (other, cover) in zip(
            asset, self._drawn(textured, cameras), strict=True
        ):
            there = photo.valid & (np.maximum(alpha, cover) > 0.5)
            if there.any():
                target = photo.rgb[there]
                lost.append(psnr(image[there], target) - psnr(other[there], target))
        return float(np.mean(lost)) if lost else 0.0


def in_world(product: Product, like: TexturedMesh, frame: AssetFrame) -> TexturedMesh:
    """A product as a textured mesh in the world's frame; what it lacks is as in `like`."""
    tangents = unit(frame.to_world(product.tangents[:, :3])).astype(np.float32)
    mesh = UvMesh(
        vertices=(frame.to_world(product.vertices) / frame.metres_per_unit).astype(np.float32),
        faces=product.faces,
        normals=unit(frame.to_world(product.normals)).astype(np.float32),
        uv=product.uv,
    )
    size = len(product.base_color)
    return TexturedMesh(
        mesh,
        np.concatenate([tangents, product.tangents[:, 3:]], 1),
        base_color=product.base_color.astype(np.uint16) * np.uint16(257),
        roughness=product.roughness.astype(np.uint16) * np.uint16(257),
        metallic=product.metallic.astype(np.uint16) * np.uint16(257),
        occlusion=product.occlusion.astype(np.uint16) * np.uint16(257),
        normal=product.normal.astype(np.uint16) * np.uint16(257),
        confidence=np.zeros((size, size), like.confidence.dtype),
    )


def studio_psnr(product: Product, asset: Product) -> float:
    """PSNR in dB of a product's pictures in the preview's studio, the asset's being the truth.

    From four sides, over the pixels that either covers.
    """
    pairs = [_studio(product, asset, 2 * np.pi * i / _STUDIO_VIEWS) for i in range(_STUDIO_VIEWS)]
    return psnr(np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]))


def _studio(product: Product, asset: Product, azimuth: float) -> tuple[F32, F32]:
    """(N, 3) sRGB of both, at the pixels that either covers."""
    origin, rays = rays_around(asset, azimuth, _STUDIO_SIDE, reach=reach_around(asset, azimuth))
    pictures, covered = [], np.zeros(len(rays), bool)
    for shown in (product, asset):
        hits = cast(shown, origin, rays)
        linear = linear_from_srgb(np.full((len(rays), 3), _BACKDROP, np.float32))
        linear[hits.rays] = shade(shown, hits, -rays[hits.rays])
        covered[hits.rays] = True
        pictures.append(np.clip(srgb_from_linear(linear), 0, 1))
    return pictures[0][covered], pictures[1][covered]
