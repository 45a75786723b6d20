"""What one photo adds to the base colours of an asset, in its own pixels."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import fractions, linear_from_srgb
from refdgs_pipe.ray_casting import Hits, Solid, at_hits
from refdgs_pipe.texture.aligning import shifts

F32 = NDArray[np.float32]

# Of the photo's longer side, as it is framed: what changes more slowly (sigma) is the mean of all
# photos; what changes still more slowly is that of the asset
_FINE, _BROAD = 0.008, 0.03
_LEAST_FINE = 2.0  # pixels, whatever the size
_COARSE = 4  # pixels for one of the pictures in which slow changes are found
_WHITE = 0.99  # sRGB: brighter pixels are clipped and tell nothing
_LEAST_MATTE = 0.3  # share of non-metal, from which on a place has detail
_DARK = 0.02  # of the light received: darker places tell nothing of the base colour
_PLAIN = 1e-3  # variance of base colours that tells no factor
_STEEPEST = 1.0  # linear: no detail is stronger


@dataclass(frozen=True, eq=False)
class PhotoDetail:
    """What one photo shows of the matte colour and the asset lacks, and where.

    Args:
        camera: of these pixels.
        depth: (H, W) of the mesh along the camera's axis, world units; 0 where there is none.
        fine: (H, W, 3) linear, without slow changes.
        broad: (H, W, 3) linear, slower changes, without very slow ones.
        slow: (H, W, 2) linear, slow changes: the asset's matte colour, and what the photo shows.
        good: (H, W) 1 where both can be used, else 0.
    """

    camera: Camera
    depth: F32
    fine: F32
    broad: F32
    slow: F32
    good: F32


@dataclass(frozen=True, eq=False)
class Comparison:
    """Of photos with an asset.

    Args:
        solid: the asset's mesh.
        received: (V, 3) linear radiance of a white matte surface at the mesh's vertices.
        textured: the asset.
        aligned_with: the same with the base colours that photos are aligned with.
        near: larger steps in depth separate two surfaces, world units.
    """

    solid: Solid
    received: F32
    textured: TexturedMesh
    aligned_with: TexturedMesh
    near: float

    def detail_of(self, photo: Photo) -> PhotoDetail | None:
        """What a photo adds; None if it shows nothing of the asset that is matte."""
        camera, mesh = photo.camera, self.textured.mesh
        rays = (camera.pixel_rays() @ camera.cam_from_world[:3, :3]).reshape(-1, 3)
        hits = self.solid.first(camera.center.astype(np.float32), rays.astype(np.float32))
        if not len(hits.rays):
            return None
        shape = (camera.height, camera.width)
        depth = np.zeros(shape, np.float32)
        depth.reshape(-1)[hits.rays] = hits.distance  # rays have a depth of one
        shown = photo.alone().reshape(-1, 3)[hits.rays]
        received = at_hits(self.received, mesh.faces, hits.face, hits.weights)
        own, aim, matte = self._matte(hits)
        use = (shown.max(1) < _WHITE) & (matte > _LEAST_MATTE) & (received.min(1) > _DARK)
        rows = hits.rays[use]
        known = np.zeros(shape, np.float32)
        known.reshape(-1)[rows] = 1
        known *= _level(depth, self.near)
        if not known.any():
            return None
        pictures = np.zeros((3, *shape, 3), np.float32)  # the photo, the asset, what it is to match
        colours = (linear_from_srgb(shown[use]) / received[use], own[use], aim[use])
        for picture, colour in zip(pictures, colours, strict=True):
            picture.reshape(-1, 3)[rows] = colour
        sharp, wide = (max(share * max(shape), _LEAST_FINE) for share in (_FINE, _BROAD))
        photo_gray, own_gray = pictures[:2].mean(-1)
        pictures[0] /= _gain(photo_gray, own_gray, known, sharp / 2, wide)[..., None]
        slow = [_slow(picture, known, sharp) for picture in pictures]
        quick = (pictures - np.stack(slow)) * known[..., None]
        flow = shifts(quick[2].mean(-1), quick[0].mean(-1), known)
        lacks = (_moved(quick[0], flow) - quick[1]) * known[..., None]
        fine = np.asarray(lacks.clip(-_STEEPEST, _STEEPEST), np.float32)
        apart = slow[0] - slow[1]
        broad = np.asarray(apart - _slow(apart, known, wide), np.float32)
        good = np.asarray(cv2.erode(known, np.ones((3, 3), np.uint8)), np.float32)
        grays = np.stack([slow[1].mean(-1), slow[0].mean(-1)], -1)
        return PhotoDetail(camera, depth, fine, broad, grays, good)

    def _matte(self, hits: Hits) -> tuple[F32, F32, F32]:
        """Matte colours (N, 3) of both assets and matte shares (N,), of the nearest texels."""
        mesh, size = self.textured.mesh, self.textured.size
        uv = at_hits(mesh.uv, mesh.faces, hits.face, hits.weights)
        column, row = np.clip((uv * size).astype(np.int64), 0, size - 1).T
        matte = 1 - fractions(self.textured.metallic[row, column])
        own, like = (
            linear_from_srgb(fractions(one.base_color[row, column])) * matte[:, None]
            for one in (self.textured, self.aligned_with)
        )
        return own, like, matte


def _slow(values: F32, known: F32, sigma: float) -> F32:
    """(H, W, 3) the mean of what is known around, sigma in pixels."""
    height, width = known.shape
    step = _COARSE if sigma >= 2 * _COARSE else 1
    few = (max(1, width // step), max(1, height // step))
    parts = (values * known[..., None], known)
    total, share = (
        cv2.GaussianBlur(cv2.resize(part, few, interpolation=cv2.INTER_AREA), (0, 0), sigma / step)
        for part in parts
    )
    mean = total / np.maximum(share, 1e-3)[..., None]
    return np.asarray(cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _gain(photo: F32, shown: F32, known: F32, sharp: float, broad: float) -> F32:
    """(H, W) how much stronger contrasts are in the photo than in what the asset shows.

    The light received is known but for a factor, and what a photo mirrors adds a slow change. The
    slope of a line through both, over the pixels around, takes no account of the latter. Where the
    asset is plain, the slope over the whole photo counts.

    Args:
        photo, shown, known: (H, W).
        sharp, broad: pixels (sigma); what is broader than `sharp` is alike in both.
    """
    share = np.maximum(cv2.GaussianBlur(known, (0, 0), sharp), 1e-3)
    one, other = (cv2.GaussianBlur(v * known, (0, 0), sharp) / share for v in (photo, shown))
    means = _slow(np.stack([one, other, one * other], -1), known, broad)
    squares = _slow(np.repeat((other * other)[..., None], 3, -1), known, broad)[..., 0]
    along = means[..., 2] - means[..., 0] * means[..., 1]
    spread = np.maximum(squares - means[..., 1] ** 2, 0)
    there = known > 0
    whole = float(along[there].sum() / max(float(spread[there].sum()), _PLAIN))
    usual = np.clip(whole, 0.5, 2.0) if spread[there].mean() > _PLAIN else 1.0
    slope = (along + _PLAIN * usual) / (spread + _PLAIN)
    return np.asarray(np.clip(slope, 0.5, 2.0), np.float32)


def _moved(values: F32, flow: F32) -> F32:
    """(H, W, 3) values looked up beside each pixel, at a shift (H, W, 2)."""
    y, x = np.mgrid[0 : flow.shape[0], 0 : flow.shape[1]].astype(np.float32)
    found = cv2.remap(values, x + flow[..., 0], y + flow[..., 1], cv2.INTER_CUBIC)
    return np.asarray(found, np.float32)


def _level(depth: F32, near: float) -> F32:
    """(H, W) 1 where the mesh has no step in depth close by."""
    kernel = np.ones((3, 3), np.uint8)
    whole = cv2.erode((depth > 0).astype(np.uint8), kernel, borderValue=0)
    bends = [np.abs(cv2.Sobel(depth, cv2.CV_32F, *d, ksize=1)) for d in ((2, 0), (0, 2))]
    steps = cv2.dilate((np.maximum(*bends) > near).astype(np.uint8), kernel)
    return np.asarray((whole > 0) & (steps == 0), np.float32)
