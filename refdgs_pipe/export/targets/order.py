"""What every target is made from, and textures at other sizes."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import fractions, linear_from_srgb, srgb_from_linear
from refdgs_pipe.export.files import Surroundings
from refdgs_pipe.export.product import Product
from refdgs_pipe.vectors import unit

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]


class Level(Protocol):
    """A mesh with fewer triangles: see `refdgs_pipe.texture.levels`, world units."""

    @property
    def textured(self) -> TexturedMesh: ...
    @property
    def mean(self) -> float: ...
    @property
    def percentile_95(self) -> float: ...


@dataclass(frozen=True)
class Coarse:
    """The product with fewer triangles.

    Args:
        mean, percentile_95: distance of both meshes' vertices to the other mesh, in percent of
            the diagonal of the asset's box.
    """

    product: Product
    mean: float
    percentile_95: float


@dataclass(frozen=True)
class Order:
    """What targets are made from.

    Args:
        folder: of the exported files; `asset.glb` is there already.
        textured: the asset with 16 bits, in the world's frame.
        turned: what makes a product of a textured mesh.
        level: the textured mesh with at most that many triangles.
        loss: how many dB of PSNR against the photos another product has less than the asset;
            None where no light is known to draw it in.
        size: how long the asset is, and what tells it, in words.
        is_size_known: whether anything tells it.
    """

    folder: Path
    textured: TexturedMesh
    around: Surroundings
    turned: Callable[[TexturedMesh], Product]
    level: Callable[[int], Level]
    loss: Callable[[Product], float] | None
    size: str
    is_size_known: bool
    _coarse: dict[int, Coarse] = field(default_factory=dict)

    @cached_property
    def product(self) -> Product:
        """The asset."""
        return self.turned(self.textured)

    def coarse(self, budget: int) -> Coarse:
        """The product with at most that many triangles."""
        if budget not in self._coarse:
            found = self.level(budget)
            diagonal = float(np.linalg.norm(np.ptp(self.textured.mesh.vertices, axis=0)))
            far, mean = (100 * x / diagonal for x in (found.percentile_95, found.mean))
            self._coarse[budget] = Coarse(self.turned(found.textured), mean, far)
        return self._coarse[budget]


@dataclass(frozen=True)
class Made:
    """What one target came to.

    Args:
        summary: one line for people.
        figures: name -> number or text, as asset.json keeps them.
        notes: what the user should know of these files.
        warnings: where the result is not what the target promises.
    """

    summary: str
    figures: dict[str, float | int | str]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def with_textures(product: Product, longest: int) -> Product:
    """The product with textures of at most that many texels a side."""
    if len(product.base_color) <= longest:
        return product
    color = linear_from_srgb(fractions(product.base_color))
    normal = _smaller(fractions(product.normal) * 2 - 1, longest)
    return replace(
        product,
        base_color=_eight(srgb_from_linear(_smaller(color, longest))),
        roughness=_eight(_smaller(fractions(product.roughness), longest)),
        metallic=_eight(_smaller(fractions(product.metallic), longest)),
        occlusion=_eight(_smaller(fractions(product.occlusion), longest)),
        normal=_eight(unit(normal) * 0.5 + 0.5),
    )


def _smaller(picture: F32, side: int) -> F32:
    return np.asarray(cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _eight(picture: F32) -> U8:
    return np.asarray(np.round(np.clip(picture, 0, 1) * 255), np.uint8)
