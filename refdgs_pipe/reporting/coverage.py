"""How certain the surface is, and where it has holes."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.evaluation.wholeness import WELL, open_rims
from refdgs_pipe.export.turntable import INSIDE, LITTLE, MUCH, UNSEEN, render_coverage
from refdgs_pipe.formatting import counted
from refdgs_pipe.reporting.asset import product_of
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Html, figure, image, joined, table, tag
from refdgs_pipe.reporting.pictures import webp
from refdgs_pipe.texture.texels import rasterize

U8 = NDArray[np.uint8]
_FRAMES, _FRAME, _MAP = 4, 300, 512


def coverage(facts: Facts, _: Drawing) -> Html:
    """The mesh and its atlas, coloured by how certain their shape is; holes."""
    textured = facts.load(TexturedMesh)
    sides = render_coverage(product_of(facts), count=_FRAMES, side=_FRAME)
    pictures = [
        image(webp(side), f"how certain the shape is, side {i}", (_FRAME, _FRAME))
        for i, side in enumerate(sides, 1)
    ]
    side = min(_MAP, textured.size)
    step = textured.size // side
    texels = rasterize(textured.mesh, side)
    trust = textured.confidence[::step, ::step].reshape(-1)[texels.index] / np.float32(65535)
    atlas = np.zeros((side * side, 4), np.float32)
    atlas[texels.index, :3] = np.where(
        trust[:, None] > 0, LITTLE + (MUCH - LITTLE) * trust[:, None], UNSEEN
    )
    atlas[texels.index, 3] = 1
    few = (trust > 0) & (trust < WELL)
    rows = [
        ("in no photo: its colour is filled in from beside it", trust == 0, UNSEEN),
        (
            "a guess: few photos show it, or neither an outline nor fine detail tells its shape",
            few,
            LITTLE,
        ),
        ("known well", trust >= WELL, MUCH),
    ]
    shares: list[tuple[Html | str, ...]] = [
        (joined(_swatch(color), f" {name}"), f"{there.mean() if len(there) else 0:.1%}")
        for name, there, color in rows
    ]
    shares.append((joined(_swatch(INSIDE), " the inside, through a hole"), _holes(textured)))
    label = "the texture, in the same colours"
    picture = np.round(atlas.reshape(side, side, 4) * 255).astype(np.uint8)
    words = "More photos of red and yellow parts help, from several heights."
    return joined(
        tag("p", words),
        tag("div", *pictures, class_="quad"),
        tag(
            "div",
            table(("part of the surface", "share"), shares),
            figure(image(webp(picture), label, (side, side)), label),
            class_="pair",
        ),
        tag("p", "As grey values it is in the file textures/confidence.png.", class_="hint"),
    )


def _swatch(color: NDArray[np.float32]) -> Html:
    """A small square of an sRGB colour."""
    code = "#" + "".join(f"{round(float(value) * 255):02x}" for value in color)
    square = tag("rect", width=10, height=10, fill=code)
    return tag("svg", square, width=10, height=10, viewBox="0 0 10 10", role="presentation")


def _holes(textured: TexturedMesh) -> str:
    lengths, _ = open_rims(textured.mesh)
    if not len(lengths):
        return "none"
    return counted(len(lengths), "hole")
