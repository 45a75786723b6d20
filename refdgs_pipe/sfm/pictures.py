"""The photos and masks in the form that COLMAP reads."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.files.images import read_png, write_png

MaskUse = Literal["none", "object", "background"]


@dataclass(frozen=True)
class Pictures:
    """The pictures that features are looked for in.

    Args:
        folder: holds NAME.png for each view.
        sizes: name of a view -> width and height of its picture, pixels.
    """

    folder: Path
    sizes: dict[str, tuple[int, int]]


def plain_images(views: Views, scratch: Path) -> Pictures:
    """A folder of 8-bit sRGB PNGs: the views' own, or one in `scratch`.

    Larger pictures that ingest kept for placing are linked there, 16-bit ones are converted.
    """
    own = views.folder / "images"
    is_plain = all(read_png(views.image_path(view)).dtype == np.uint8 for view in views.items[:1])
    if is_plain and all(views.placing_path(v) == views.image_path(v) for v in views.items):
        return Pictures(own, {view.name: (view.width, view.height) for view in views.items})
    folder, sizes = scratch / "images", {}
    folder.mkdir(parents=True, exist_ok=True)
    for view in views.items:
        target, source = folder / f"{view.name}.png", views.placing_path(view)
        if not target.exists():
            pixels = read_png(source)
            if pixels.dtype == np.uint8:
                target.symlink_to(source.resolve())
            else:
                unit = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
                encoded = srgb_from_linear(unit) if views.color_space == "linear" else unit
                write_png(target, (encoded * 255).round().astype(np.uint8))
        height, width = read_png(target).shape[:2]
        sizes[view.name] = (width, height)
    return Pictures(folder, sizes)


def feature_masks(views: Views, pictures: Pictures, use: MaskUse, scratch: Path) -> Path | None:
    """A folder of NAME.png.png, black where COLMAP shall find no features; None for no masks."""
    if use == "none":
        return None
    folder = scratch / f"masks-{use}"
    for view in views.items:
        path = views.mask_path(view)
        if path is not None:
            mask = np.asarray(read_png(path), np.uint8)
            size = pictures.sizes[view.name]
            if size != (view.width, view.height):
                mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR), np.uint8)
            is_object = mask >= 128
            kept = is_object if use == "object" else ~is_object
            write_png(folder / f"{view.name}.png.png", kept.astype(np.uint8) * 255)
    return folder
