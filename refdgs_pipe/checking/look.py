"""A quick look at a capture: its photos small, and one fast try to place them.

It takes the way of `run`, with small pictures, few features and one rung of the ladder. What it
cannot place a run may still place, for it tries harder.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.placement import Placement, Poses
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.checking.pixels import Exposure, exposures_of
from refdgs_pipe.child_process import ChildCrashed, ChildTimeout
from refdgs_pipe.errors import CaptureError, PoseError
from refdgs_pipe.pipeline.catalog import load_stages
from refdgs_pipe.pipeline.events import Event, Progress, Warned
from refdgs_pipe.pipeline.stage import Job
from refdgs_pipe.sfm.gate import Judgement, examine

SIDE = 800  # px, of the photos that are looked at; their features are looked for at twice the size
FEATURES = 1500  # of a photo
MOST_PLACED = 100  # photos; of more, evenly chosen ones are placed
TIME_LIMIT_S = 1800.0  # for placing; a machine that is so busy tells nothing

OnProgress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class Look:
    """What a quick look found.

    Args:
        root: where the photos are.
        files: files that were given; megapixels: of the middle photo, None if unknown.
        views: the photos, small; None if they cannot be read.
        refused: why they cannot, in words.
        warnings: what reading them warned about.
        placement: the quick try; None for known poses, or if nothing was read.
        judgement: what the gate says of it.
        model: the photos with a place, from the try or as it came with the capture.
        tried: the photos that took part in the try.
        exposures: name of a view -> how it is exposed.
    """

    root: Path
    files: int
    megapixels: float | None
    views: Views | None = None
    refused: str = ""
    warnings: tuple[str, ...] = ()
    placement: Placement | None = None
    judgement: Judgement | None = None
    model: SparseModel | None = None
    tried: tuple[View, ...] = ()
    exposures: dict[str, Exposure] = field(default_factory=dict)

    @property
    def is_known(self) -> bool:
        """Whether the capture came with poses."""
        return self.views is not None and self.views.has_known_poses


def take_look(
    paths: tuple[Path, ...],
    scratch: Path,
    *,
    least: float,
    threads: int,
    progress: OnProgress,
    stop: threading.Event,
) -> Look:
    """Look at a capture; nothing is written but below `scratch`.

    Args:
        least: share of the photos that must have a trusted place, as the stage `gate` asks.

    Raises:
        InputError, CaptureError: the paths do not exist, or hold no photos.
        Cancelled: `stop` was set.
    """
    capture = Capture(paths)
    layout = capture.layout()
    files = capture.files()
    look = Look(layout.root, len(layout.photos) or len(files), _megapixels([p for _, p in files]))
    warnings: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Warned):
            warnings.append(event.text)
        elif isinstance(event, Progress):
            progress(event.label, event.done, event.total)

    try:
        views = _read(capture, scratch, threads, listen, stop)
    except CaptureError as error:
        return replace(look, refused=str(error), warnings=tuple(warnings))
    look = replace(look, views=views, warnings=tuple(warnings), exposures=exposures_of(views))
    if views.has_known_poses:
        return _with_known_poses(look, views)
    return _placed(look, views, scratch, least=least, threads=threads, told=progress, stop=stop)


def _read(
    capture: Capture,
    scratch: Path,
    threads: int,
    listen: Callable[[Event], None],
    stop: threading.Event,
) -> Views:
    """What the stage `ingest` makes of the photos at a small size."""
    stage = next(stage for stage in load_stages() if stage.output is Views)
    folder, own = scratch / "views", scratch / "reading"
    for path in (folder, own):
        path.mkdir(parents=True)
    job = Job(stage.name, folder, own, "cpu", threads, listen, stop)
    views = stage.run(
        capture, stage.params.model_validate({"max_side": SIDE, "placing_side": SIDE}), job
    )
    assert isinstance(views, Views)
    return views


def _with_known_poses(look: Look, views: Views) -> Look:
    from refdgs_pipe.sfm.known import model_from_known_poses

    try:
        return replace(look, model=model_from_known_poses(views))
    except PoseError as error:
        return replace(look, refused=str(error))


def _placed(
    look: Look,
    views: Views,
    scratch: Path,
    *,
    least: float,
    threads: int,
    told: OnProgress,
    stop: threading.Event,
) -> Look:
    """Place the photos with few features, once, and let the gate judge the result."""
    from refdgs_pipe.child_process import call_in_child
    from refdgs_pipe.sfm.pictures import plain_images
    from refdgs_pipe.sfm.poses import Effort, Found
    from refdgs_pipe.sfm.solve import solve

    step = -(-len(views.items) // MOST_PLACED)
    views = replace(views, items=views.items[::step])
    asked = False

    def once(arguments: dict[str, Any]) -> Found:
        """The answer of the first rung; harder rungs place nothing."""
        nonlocal asked
        if asked:
            return _nowhere(), ()
        asked = True
        target, limit = "refdgs_pipe.sfm.colmap:reconstruct", TIME_LIMIT_S
        try:
            found: Found = call_in_child(
                target, arguments, timeout_s=limit, stop=stop, on_progress=told
            )
        except (ChildCrashed, ChildTimeout) as error:
            note = f"the quick try ended early: {str(error).splitlines()[0]}"
            return _nowhere(), (note,)
        return found

    effort = Effort(SIDE, FEATURES, -1, threads)
    pictures = plain_images(views, scratch)
    placement = solve(views, pictures, effort, masks="none", scratch=scratch, run=once)
    first, *others = placement.attempts
    tried = (replace(first, name="a quick try"), *(a for a in others if "mat" in a.name))
    placement = replace(placement, attempts=tried)
    judgement = examine(views, placement, least=least)
    return replace(
        look, placement=placement, judgement=judgement, model=judgement.model, tried=views.items
    )


def _nowhere() -> Poses:
    """No photo with a place."""
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return Poses({}, {}, (), points, colors, {}, 0.0, "incremental")


def _megapixels(paths: list[Path]) -> float | None:
    """Of the middle photo among some of the files."""
    from refdgs_pipe.files.images import read_header

    sizes = []
    for path in paths[:: max(1, len(paths) // 12)]:
        try:
            header = read_header(path)
        except (CaptureError, OSError):
            continue
        sizes.append(header.width * header.height / 1e6)
    return sorted(sizes)[len(sizes) // 2] if sizes else None
