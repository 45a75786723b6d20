"""The trained field: how training went, how its views compare with photos, and what it learned."""

from collections.abc import Callable
from contextlib import suppress

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import CorruptError, RefdgsError
from refdgs_pipe.formatting import counted
from refdgs_pipe.metrics import psnr
from refdgs_pipe.reporting import plots
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Html, figure, image, joined, tag
from refdgs_pipe.reporting.pictures import eight_bits, error_map, webp, with_alpha

F32 = NDArray[np.float32]
DEVICE = "cpu"  # some small pictures: no GPU is worth waking up for them
_LONGEST = 440  # px of what is rendered
_COMPARED, _MAPPED = 6, 3  # views


def training(facts: Facts, _: Drawing) -> Html:
    """Loss and PSNR over the steps, from the log of the run that trained."""
    curve = facts.notes.curve
    if len(curve) < 2:
        return tag("p", "The log of the run that trained is not there any more.", class_="none")
    loss = plots.curve([(step, y) for step, y, _ in curve], label="loss over steps", log=True)
    fit = plots.curve([(step, y) for step, _, y in curve], label="PSNR over steps")
    return tag(
        "div",
        figure(loss, "What training makes small, over its steps; lower is better"),
        figure(fit, "Likeness to the photos of the training (PSNR, dB); higher is better"),
        class_="pair",
    )


def comparisons(facts: Facts, drawing: Drawing) -> Html:
    """Photo, render and error of held-out views, from the worst to the best."""
    from refdgs_pipe.training.render import render_image

    relit = _relit(facts, drawing.threads)
    field = facts.load(SurfelField)
    model = facts.load(SparseModel).placed(field.poses, field.ball)
    views = facts.load(Views)
    if facts.result(Masks) is not None:
        views = facts.load(Masks).applied(views, model.names)
    cameras = chosen_cameras(facts, model, _COMPARED)
    held = any(camera.split == "test" for camera in cameras)
    rows = []
    for camera in cameras:
        scale = camera.fitted(_LONGEST).width / camera.width
        photo = load_photo(views, model, camera, scale=scale)
        target = _over_white(photo)
        drawn = render_image(field, photo.camera, device=DEVICE, threads=drawing.threads)
        shown = [("learned", drawn)]
        if relit is not None:
            behind = drawn if photo.mask is None else np.ones_like(drawn)
            color, alpha = relit(photo.camera)
            over = color * alpha[..., None] + behind * (1 - alpha[..., None])
            shown.append(("asset", over.astype(np.float32)))
        rows.append(_row(views[camera.name].source or camera.name, photo, target, shown))
    kind = "were kept for testing" if held else "were used for learning too (none was kept)"
    words = (
        f"These photos {kind}. The worst comes first. Beside each photo: what was learned, drawn "
        "from the same place; the finished asset in the light that was found; and where the two "
        "differ, bright where they differ most."
    )
    open_ones = {0, len(rows) // 2, len(rows) - 1}  # worst, middle, best; the others on demand
    first = [row for i, row in enumerate(rows) if i in open_ones]
    more = [row for i, row in enumerate(rows) if i not in open_ones]
    others = Html("")
    if more:
        others = tag("details", tag("summary", counted(len(more), "more photo")), *more)
    return joined(tag("p", words), *first, others)


def chosen_cameras(facts: Facts, model: SparseModel, count: int) -> list[Camera]:
    """Held-out cameras, or training ones where none was held out: evenly from worst to best."""
    held = [camera for camera in model.cameras if camera.split == "test"] or list(model.cameras)
    with suppress(RefdgsError):  # not there, or from an older version
        by_name = {score.name: score.psnr for score in facts.load(Scores).views}
        held = sorted(held, key=lambda camera: by_name.get(camera.name, np.inf))
    return [held[i] for i in np.unique(np.linspace(0, len(held) - 1, count).round().astype(int))]


def _relit(facts: Facts, threads: int) -> Callable[[Camera], tuple[F32, F32]] | None:
    """What draws the textured mesh in its own light, if there are both."""
    from refdgs_pipe.relight import relit

    with suppress(RefdgsError):  # not made yet, or from an older version
        return relit(facts.load(TexturedMesh), facts.load(Appearance), threads=threads)
    return None


def _row(name: str, photo: Photo, target: F32, shown: list[tuple[str, F32]]) -> Html:
    seen = photo.valid
    height, width = target.shape[:2]

    def quality(drawn: F32) -> str:
        return f"{psnr(drawn[seen], target[seen]):.2f} dB" if seen.any() else "nothing to compare"

    def picture(pixels: NDArray[np.uint8], kind: str) -> Html:
        return figure(image(webp(pixels), f"{kind} of {name}", (width, height)), kind)

    pictures = [picture(eight_bits(target), "photo")]
    pictures += [picture(eight_bits(drawn), kind) for kind, drawn in shown]
    pictures.append(picture(error_map(shown[0][1], target, seen), "difference"))
    words = ", ".join(f"{kind} {quality(drawn)}" for kind, drawn in shown)
    words = f"likeness (PSNR): {words}"
    class_ = "triple" if len(pictures) == 3 else "quad"
    return tag(
        "div", tag("h3", name, tag("small", f" {words}")), tag("div", *pictures, class_=class_)
    )


def maps(facts: Facts, drawing: Drawing) -> Html:
    """Normals, diffuse colour, roughness and reflections of some views."""
    from refdgs_pipe.training.render import render_surface_map

    field = facts.load(SurfelField)
    model = facts.load(SparseModel).placed(field.poses, field.ball)
    rows = []
    for camera in chosen_cameras(facts, model, _MAPPED):
        sized = camera.fitted(_LONGEST)
        seen = render_surface_map(field, sized, device=DEVICE, threads=drawing.threads)
        layers: tuple[tuple[str, F32], ...] = (
            ("surface direction", seen.normal * 0.5 + 0.5),
            ("colour without reflections", srgb_from_linear(seen.diffuse)),
            ("roughness: white is rough", seen.roughness),
            ("reflections", srgb_from_linear(seen.specular)),
        )
        size = (sized.width, sized.height)
        pictures = [
            figure(
                image(webp(with_alpha(values, seen.alpha)), f"{kind} of {camera.name}", size), kind
            )
            for kind, values in layers
        ]
        rows.append(tag("div", *pictures, class_="quad"))
    words = (
        "What was learned of the object, before it became a mesh with textures. The colour of the "
        "surface direction says where the surface faces. Reflections are the light that it mirrors."
    )
    return joined(tag("p", words), *rows)


def surroundings(facts: Facts, _: Drawing) -> Html:
    """The light that the object stood in, as it mirrors it."""
    path = facts.folder(Asset) / "environment.hdr"
    if not path.exists():
        return tag(
            "p",
            "There is none: the object was learned as matte, or by an older version.",
            class_="none",
        )
    light = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if light is None:
        raise CorruptError(f"{path.name}: not a readable picture")
    pixels = webp(eight_bits(srgb_from_linear(np.asarray(light[..., ::-1], np.float32))))
    size = (light.shape[1], light.shape[0])
    words = (
        "The light around the object, as its reflections show it (environment.hdr). The middle is "
        "in front of the object, its right side is on the left. Sides that nothing mirrored are "
        "guesses."
    )
    picture = image(pixels, "lat-long picture of the surroundings", size, class_="wide")
    return joined(tag("p", words), _movement(facts), picture)


def _movement(facts: Facts) -> Html:
    """How the light moved from photo to photo, and what to do if that is wrong."""
    with suppress(RefdgsError):  # an older version did not look for it
        found = facts.load(Lighting)
        words = {
            "world": "The light stood still with the object",
            "turntable": "The object turned while camera and room stood still; the picture shows "
            "the room as it lay for the first ring of photos",
            "flash": "A flash on the camera lit the object; the picture shows the room without it",
        }[found.kind]
        because = f" ({found.reason})" if found.reason else ""
        other = " If that is wrong, set lighting.kind and run again."
        return tag("p", f"{words}{because}.{other}")
    return joined()


def _over_white(photo: Photo) -> F32:
    if photo.mask is None:
        return photo.rgb
    m = photo.mask[..., None]
    return np.asarray(photo.rgb * m + (1 - m), np.float32)
