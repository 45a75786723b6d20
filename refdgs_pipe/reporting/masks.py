"""Where the object was found in photos without masks: their masks, drawn on them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Html, coded, figure, image, joined, tag
from refdgs_pipe.reporting.pictures import eight_bits, webp
from refdgs_pipe.reporting.placement import spread

U8 = NDArray[np.uint8]
_SIDE = 480  # px of a picture's longer side
_DARK = 0.3  # of the brightness, around the object
_LINE = (255, 220, 60)  # RGB


def masks(facts: Facts, _: Drawing) -> Html:
    """Some photos, dark where they show no object; or why there are no masks."""
    found = facts.load(Masks)
    if found.kind == "given":
        return tag("p", "The photos came with masks.", class_="hint")
    if found.kind == "none":
        return tag(
            "p",
            f"No masks were found: {found.reason}. Training looks for the object itself.",
            class_="hint",
        )
    model = facts.load(SparseModel)
    views = found.applied(facts.load(Views), model.names)
    figures = []
    for camera in spread(model):
        try:
            scale = min(1.0, _SIDE / max(camera.width, camera.height))
            pixels = draw_mask(load_photo(views, model, camera, scale=scale))
        except (RefdgsError, OSError, cv2.error):
            continue
        name = views[camera.name].source or camera.name
        size = (pixels.shape[1], pixels.shape[0])
        figures.append(figure(image(webp(pixels, 78), f"the object in {name}", size), name))
    maker = "Your network made these masks. " if found.kind == "network" else ""
    words = (
        f"{maker}What is dark is taken for surroundings. Where that is wrong, edit the masks and "
        "give them back: `refdgs-pipe adopt WORKSPACE masks FOLDER`."
    )
    return joined(
        tag("p", coded(words), class_="hint"), tag("div", *figures, class_="tripled overlay")
    )


def draw_mask(photo: Photo) -> U8:
    """(h, w, 3) RGB: a photo, dark around its object, with the mask's outline."""
    mask = np.ones(photo.rgb.shape[:2], np.float32) if photo.mask is None else photo.mask
    shown = photo.rgb * (_DARK + (1 - _DARK) * mask[..., None])
    pixels = np.ascontiguousarray(eight_bits(shown.astype(np.float32)))
    inside = (mask > 0.5).astype(np.uint8)
    lines, _ = cv2.findContours(inside, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(pixels, lines, -1, _LINE, 1, cv2.LINE_AA)
    return np.asarray(pixels, np.uint8)
