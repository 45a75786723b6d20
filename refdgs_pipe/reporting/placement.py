"""How the photos were placed: what was tried, what the gate says, and a picture of the result."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.placement import Attempt, Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Content, Html, figure, image, joined, table, tag
from refdgs_pipe.reporting.pictures import eight_bits, webp
from refdgs_pipe.sfm.gate import Check, Judgement, examine, with_places

U8 = NDArray[np.uint8]
_PICTURES, _SIDE = 6, 480  # photos with an overlay; px of their longer side
_POINTS = 1500  # of one photo, drawn
_INSIDE, _OUTSIDE = (60, 220, 90), (255, 150, 30)  # RGB
_BALL, _CAMERA = (255, 255, 255), (70, 150, 255)


def placement(facts: Facts, _: Drawing) -> Html:
    """The ladder's rungs, the gate's checks with advice, notes, and the overlay."""
    views, found = facts.load(Views), facts.load(Placement)
    if found.known:
        return tag("p", _given(found))
    judgement = judged(facts, views, found)
    model = _current_model(facts) or judgement.model
    if model is not None and judgement.may_be_trusted:  # the ground may have placed more photos
        judgement = with_places(judgement, views, found, model, least=_least(facts))
    return joined(
        verdict_line(judgement, len(views.items)),
        attempts_table(found.attempts),
        notes_list([*found.notes, *judgement.gaps]),
        checks_table(judgement.checks),
        overlay(views, model),
    )


def _given(found: Placement) -> str:
    """What is said of places that came with the photos."""
    if found.poses is None:
        return "The places came with the photos; nothing had to be found."
    return (
        f"The places came with the photos. {len(found.poses.points)} points were found in them, "
        f"{found.poses.error_px:.2f} px from where the photos show them on average."
    )


def judged(facts: Facts, views: Views, found: Placement) -> Judgement:
    """What the gate says of a placement, with the settings of the workspace."""
    return examine(views, found, least=_least(facts))


def _least(facts: Facts) -> float:
    """Share of the photos that must have a trusted place."""
    return float(facts.settings.get("gate", {}).get("min_trusted", 0.7))


def lost_photos(facts: Facts) -> dict[str, str]:
    """Name of a view -> why it has no place: as the gate noted, or would have if it had passed."""
    if (model := _current_model(facts)) is not None:
        return {lost.name: lost.reason for lost in model.lost}
    if facts.result(Placement) is not None:
        found = facts.load(Placement)
        if not found.known:
            return judged(facts, facts.load(Views), found).lost
    if facts.result(SparseModel) is not None:
        return {lost.name: lost.reason for lost in facts.load(SparseModel).lost}
    return {}


def _current_model(facts: Facts) -> SparseModel | None:
    """The gate's model, unless it stems from an older placement."""
    result = facts.result(SparseModel)
    return facts.load(SparseModel) if result is not None and result.is_current else None


def verdict_line(judgement: Judgement, total: int) -> Html:
    """Whether the places can be trusted, in one line."""
    count = f"{total - len(judgement.lost)} of {total} photos have a place that can be trusted."
    word = "The places can be trusted." if judgement.is_trusted else "The places are not trusted."
    kind = "ok" if judgement.is_trusted else "bad"
    return tag("p", tag("b", word, class_=kind), " ", count)


def attempts_table(attempts: Sequence[Attempt]) -> Html:
    """What was tried, in order."""
    rows: list[tuple[Content, ...]] = [
        (a.name, str(a.placed), str(a.trusted), f"{a.points:,}") for a in attempts
    ]
    head = ("tried", "placed", "trusted", "points")
    return table(head, rows, class_="attempts") if rows else Html("")


def checks_table(checks: Sequence[Check]) -> Html:
    """The gate's checks, with advice where one is not met."""
    rows: list[tuple[Content, ...]] = []
    for check in checks:
        word = tag("b", "ok", class_="ok") if check.is_met else tag("b", "no", class_="bad")
        found = check.found
        said = found if check.is_met else joined(found, tag("br"), tag("small", check.advice))
        rows.append((check.name, word, said))
    return table(("check", "met", "found"), rows, class_="checks") if rows else Html("")


def notes_list(notes: Sequence[str]) -> Html:
    """Sentences as a list."""
    return tag("ul", *(tag("li", note) for note in notes)) if notes else Html("")


def overlay(views: Views, model: SparseModel | None) -> Html:
    """Photos with the sparse points, the ball's outline and the other cameras on them."""
    if model is None or len(model.cameras) < 2:
        return tag("p", "Too few photos have a place to draw a picture of them.", class_="hint")
    said = {view.name: view.source or view.name for view in views.items}
    figures = []
    for camera in spread(model):
        try:
            pixels = draw_overlay(views, model, camera)
        except (RefdgsError, OSError, cv2.error):
            continue
        name = said.get(camera.name, camera.name)
        size = (pixels.shape[1], pixels.shape[0])
        figures.append(figure(image(webp(pixels, 78), f"points on {name}", size), name))
    words = (
        "Green: points of this photo inside the ball that the object is taken to lie in. Orange: "
        "its points outside. White ring: the ball. Blue: where other photos were taken from. "
        "Points have to lie on what they show, and the ring round the object."
    )
    return joined(tag("p", words, class_="hint"), tag("div", *figures, class_="tripled overlay"))


def spread(model: SparseModel) -> list[Camera]:
    """Some cameras, each as far as possible from those chosen before."""
    centers = np.stack([camera.center - model.ball.center for camera in model.cameras])
    chosen = [0]
    apart = np.linalg.norm(centers - centers[0], axis=1)
    while len(chosen) < min(_PICTURES, len(centers)):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(centers - centers[chosen[-1]], axis=1))
    return [model.cameras[i] for i in sorted(chosen)]


def draw_overlay(views: Views, model: SparseModel, camera: Camera) -> U8:
    """(h, w, 3) RGB: one photo, undistorted, with what is known of its surroundings drawn on it."""
    scale = min(1.0, _SIDE / max(camera.width, camera.height))
    photo = load_photo(views, model, camera, scale=scale)
    small = photo.camera
    pixels = np.ascontiguousarray(eight_bits(photo.rgb * np.float32(0.8)))
    if photo.mask is not None and views.background == "removed":
        pixels[photo.mask < 0.5] = 60
    points = model.points[model.tracks.get(camera.name, np.zeros(0, np.int64))]
    points = points[:: max(1, len(points) // _POINTS)]
    inside = np.linalg.norm(points - model.ball.center, axis=1) < model.ball.radius
    for chosen, color in ((~inside, _OUTSIDE), (inside, _INSIDE)):
        for at in _shown(small, points[chosen]):
            cv2.circle(pixels, _whole(at), 1, color, -1, cv2.LINE_AA)
    rim = _outline(small, model)
    if len(rim):
        line = np.round(rim * 16).astype(np.int32)
        cv2.polylines(pixels, [line], True, (0, 0, 0), 3, cv2.LINE_AA, 4)
        cv2.polylines(pixels, [line], True, _BALL, 1, cv2.LINE_AA, 4)
    others = np.stack([c.center for c in model.cameras if c.name != camera.name])
    for at in _shown(small, others):
        cv2.drawMarker(pixels, _whole(at), (0, 0, 0), cv2.MARKER_DIAMOND, 11, 3, cv2.LINE_AA)
        cv2.drawMarker(pixels, _whole(at), _CAMERA, cv2.MARKER_DIAMOND, 10, 2, cv2.LINE_AA)
    return np.asarray(pixels, np.uint8)


def _shown(camera: Camera, points: F64) -> F64:
    """(n, 2) where the points lie that are before the camera and in its picture."""
    if not len(points):
        return np.zeros((0, 2))
    at, depth = camera.project(points)
    seen = (depth > 0) & (at >= 0).all(1) & (at < (camera.width, camera.height)).all(1)
    return np.asarray(at[seen])


def _outline(camera: Camera, model: SparseModel) -> F64:
    """(n, 2) the ball's rim as the camera sees it; empty if the camera stands in it."""
    line = model.ball.center - camera.center
    distance = float(np.linalg.norm(line))
    radius = model.ball.radius
    if distance <= radius * 1.001:
        return np.zeros((0, 2))
    axis = line / distance
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    share = (radius / distance) ** 2  # the circle where rays touch the ball
    middle = model.ball.center - axis * (radius * radius / distance)
    reach = radius * np.sqrt(1 - share)
    turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)[:, None]
    rim = middle + reach * (np.cos(turn) * side + np.sin(turn) * other)
    at, depth = camera.project(rim)
    far = 8.0 * max(camera.width, camera.height)
    is_drawn = bool((depth > 0).all() and (np.abs(at) < far).all())
    return np.asarray(at) if is_drawn else np.zeros((0, 2))


def _whole(at: F64) -> tuple[int, int]:
    return int(at[0]), int(at[1])
