"""The photos: a contact sheet with what is wrong with each, and where they were taken."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.formatting import counted
from refdgs_pipe.geometry import y_up_from_z_up
from refdgs_pipe.imaging.quality import blurred
from refdgs_pipe.reporting import plots
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Html, figure, image, joined, tag
from refdgs_pipe.reporting.pictures import thumbnail, webp
from refdgs_pipe.reporting.placement import lost_photos

_SIDE = 168  # px, the longer side of a thumbnail
_AT_ONCE = 24  # photos shown before "show the others"
_MOST = 400  # photos shown at all; those with a fault always are
_POINTS = 500  # sparse points in a plot


def contact_sheet(facts: Facts, _: Drawing) -> Html:
    """Every photo, those with a fault first, and the files that were left out."""
    views = facts.load(Views)
    return sheet(views, photo_faults(views, lost_photos(facts)))


def sheet(views: Views, faults: dict[str, dict[str, str]]) -> Html:
    """Every photo, those with a fault first, and the files that were left out.

    Args:
        faults: as `photo_faults` gives them.
    """
    order = sorted(views.items, key=lambda view: view.name not in faults)
    shown = order[: max(_MOST, len(faults))]
    with ThreadPoolExecutor(4) as pool:
        pictures = list(pool.map(partial(_thumbnail, views), shown))
    cards = [
        _card(view, picture, faults.get(view.name, {}))
        for view, picture in zip(shown, pictures, strict=True)
    ]
    first = max(_AT_ONCE, min(len(faults), 4 * _AT_ONCE))
    parts = [_summary(views, faults, hidden=len(order) - len(shown)), _grid(cards[:first])]
    if cards[first:]:
        label = tag("summary", f"Show the other {len(cards) - first} photos")
        parts.append(tag("details", label, _grid(cards[first:])))
    skipped = [file for file in views.skipped if not file.harmless]
    if skipped:
        lines = [tag("li", tag("b", file.name), ": ", file.reason) for file in skipped]
        parts.append(joined(tag("h3", "Files that could not be read"), tag("ul", *lines)))
    return joined(*parts)


def photo_faults(views: Views, lost: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Name of a view -> {"lost" or "blurred": the reason}, for views with a fault.

    Args:
        lost: name of a view -> why it has no place.
    """
    faults: dict[str, dict[str, str]] = {}
    for index in blurred([view.sharpness for view in views.items]) if views.items else []:
        faults.setdefault(views.items[index].name, {})["blurred"] = "far less sharp than the others"
    for name, reason in lost.items():
        faults.setdefault(name, {})["lost"] = reason
    return faults


def _summary(views: Views, faults: dict[str, dict[str, str]], *, hidden: int) -> Html:
    def count(kind: str) -> int:
        return sum(kind in fault for fault in faults.values())

    held = sum(view.split == "test" for view in views.items)
    skipped = sum(not file.harmless for file in views.skipped)
    words = (
        f"{counted(len(views.items), 'photo')}: {count('lost')} lost (nothing tells where they "
        f"were taken), {count('blurred')} blurred, {held} kept for testing the result."
    )
    words += f" {counted(skipped, 'file')} could not be read." if skipped else ""
    rest = f" {counted(hidden, 'photo')} without a fault not shown." if hidden else ""
    return tag("p", words + rest)


def _thumbnail(views: Views, view: View) -> tuple[str, tuple[int, int]] | None:
    """The picture's address and its width and height; None if its file is damaged."""
    try:
        pixels = thumbnail(
            views.image_path(view),
            _SIDE,
            linear=views.color_space == "linear",
            mask=views.mask_path(view) if views.background == "removed" else None,
        )
    except (RefdgsError, OSError, ValueError, cv2.error):
        return None
    return webp(pixels, 72), (pixels.shape[1], pixels.shape[0])


def _card(view: View, picture: tuple[str, tuple[int, int]] | None, faults: dict[str, str]) -> Html:
    kinds = [*faults, *(["for testing"] if view.split == "test" else [])]
    badges = [tag("span", kind, class_=f"badge {kind.replace(' ', '-')}") for kind in kinds]
    name = view.source or view.name
    shown = tag("p", "unreadable", class_="none")
    if picture is not None:
        shown = image(picture[0], f"photo {name}", picture[1])
    why = [tag("small", reason) for reason in faults.values()]
    return figure(
        joined(shown, *badges),
        joined(tag("span", name, class_="name"), *why),
        class_=" ".join(["photo", *(kind.replace(" ", "-") for kind in kinds)]),
        title=name,
    )


def _grid(cards: list[Html]) -> Html:
    return tag("div", *cards, class_="contact")


def cameras(facts: Facts, _: Drawing) -> Html:
    """Where the photos were taken, from above and from the front, in the frame of the asset."""
    return camera_plans(facts.load(SparseModel))


def camera_plans(model: SparseModel) -> Html:
    """Where the photos of a model were taken, from above and from the front."""
    turn = y_up_from_z_up(model.up)
    center = turn @ model.ball.center
    points = model.points
    points = points[:: max(1, len(points) // _POINTS)] @ turn.T
    drawn = []
    for label, axes, names in (
        ("from above", ([1, 0, 0], [0, 0, -1]), ("right (+X)", "back (-Z)")),
        ("from the front", ([1, 0, 0], [0, 1, 0]), ("right (+X)", "up (+Y)")),
    ):
        flat = np.array(axes, float)
        marks = [_mark(camera, flat @ turn) for camera in model.cameras]
        plot = plots.plan(
            marks,
            ball=(flat @ center, model.ball.radius),
            points=points @ flat.T,
            axes=names,
            label=f"camera positions {label}",
        )
        drawn.append(figure(plot, label))
    count, lost = len(model.cameras), len(model.lost)
    words = (
        f"Where the photos were taken: {counted(count, 'place')}; {counted(lost, 'photo')} without "
        f"one. {_coverage(model)} The object is inside the circle."
    )
    key = joined(
        tag("span", "for learning", class_="key train"),
        tag("span", "for testing", class_="key test"),
    )
    return joined(tag("p", words), tag("p", key), tag("div", *drawn, class_="pair"))


def _mark(camera: Camera, flat: plots.F64) -> plots.Mark:
    forward = camera.world_from_cam[:3, 2]
    return plots.Mark(camera.name, flat @ camera.center, flat @ forward, camera.split)


def _coverage(model: SparseModel) -> str:
    """How far apart neighbouring cameras are, and how high they stood."""
    turn = y_up_from_z_up(model.up)
    away = np.array([camera.center - model.ball.center for camera in model.cameras]) @ turn.T
    if len(away) < 2:
        return ""
    azimuth = np.sort(np.degrees(np.arctan2(away[:, 0], away[:, 2])))
    gap = float(np.diff(azimuth, append=azimuth[0] + 360).max())
    height = np.degrees(np.arcsin(away[:, 1] / np.linalg.norm(away, axis=1)))
    return (
        f"The widest gap between neighbours around the object is {gap:.0f} degrees; "
        f"they stood {height.min():.0f} to {height.max():.0f} degrees above its middle."
    )
