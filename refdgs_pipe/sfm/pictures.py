"""The photos and masks in the form that COLMAP reads."""

from pathlib import Path
from typing import Literal

import numpy as np

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.files.images import read_png, write_png

MaskUse = Literal["none", "object", "background"]


def plain_images(views: Views, scratch: Path) -> Path:
    """A folder of 8-bit sRGB PNGs: the views' own, or copies in `scratch` of 16-bit ones."""
    own = views.folder / "images"
    if all(read_png(views.image_path(view)).dtype == np.uint8 for view in views.items[:1]):
        return own
    for view in views.items:
        pixels = read_png(views.image_path(view))
        unit = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
        encoded = srgb_from_linear(unit) if views.color_space == "linear" else unit
        target = scratch / "images" / Path(view.file).name
        if not target.exists():
            write_png(target, (encoded * 255).round().astype(np.uint8))
    return scratch / "images"


def feature_masks(views: Views, use: MaskUse, scratch: Path) -> Path | None:
    """A folder of NAME.png.png, black where COLMAP shall find no features; None for no masks."""
    if use == "none":
        return None
    folder = scratch / f"masks-{use}"
    for view in views.items:
        path = views.mask_path(view)
        if path is not None:
            is_object = read_png(path) >= 128
            kept = is_object if use == "object" else ~is_object
            write_png(folder / f"{Path(view.file).name}.png", kept.astype(np.uint8) * 255)
    return folder
