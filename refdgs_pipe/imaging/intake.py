"""All that comes before a set of views: masks, films, copies, and the reading of every photo."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from refdgs_pipe.artifacts.capture import Frame, Layout, safe_names
from refdgs_pipe.artifacts.views import Skipped, View, Views
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.imaging.copies import without_copies, without_same_files
from refdgs_pipe.imaging.films import take_frames
from refdgs_pipe.imaging.gather import listed, warnings_about
from refdgs_pipe.imaging.masks import with_masks
from refdgs_pipe.imaging.photos import plan_set, prepare_set


@dataclass(frozen=True)
class Desk:
    """Where and how to work.

    Args:
        folder: the views' files go here; scratch: frames of films.
        max_side, placing_side: see `Plan`; video_frames: at most so many of one film.
        stop: a flag that ends a child process.
        progress: is told what is done, how many of how many; it may raise to stop.
    """

    folder: Path
    scratch: Path
    max_side: int
    placing_side: int
    video_frames: int
    threads: int
    stop: Any
    progress: Callable[[str, int, int | None], object]


@dataclass(frozen=True)
class Intake:
    """What came of a capture.

    Args:
        frames: those that were read; results: what became of all, in order.
        linear: whether the set stays linear; inverted_masks: whether black marks the object.
        notes: what the user should know.
    """

    frames: list[Frame]
    results: list[View | Skipped]
    linear: bool
    inverted_masks: bool
    notes: list[str]


def take_in(frames: Sequence[Frame], layout: Layout, desk: Desk) -> Intake:
    """Read all photos of a capture; copies and films only where no poses are known."""
    left_out: list[Skipped] = []
    items = list(frames)
    if layout.kind == "photos":
        items, left_out = without_same_files(items)
        items, films = _with_films(items, desk)
        left_out += films
        names = safe_names([frame.source for frame in items])
        items = [replace(frame, name=name) for frame, name in zip(items, names, strict=True)]
    items, strays = with_masks(items, layout.masks, layout.root)
    plan, items, unread = plan_set(items, desk.max_side, desk.placing_side)
    results = prepare_set(
        items,
        desk.folder,
        plan,
        threads=desk.threads,
        progress=lambda done, total: desk.progress("reading photos", done, total),
    )
    if layout.kind == "photos":
        results = without_copies(items, results, desk.folder, linear=plan.linear)
    notes = []
    if strays and layout.kind == "photos":
        notes.append(f"{len(strays)} masks belong to no photo: {listed(strays)}")
    return Intake(items, [*left_out, *unread, *results], plan.linear, plan.inverted_masks, notes)


def notes_on(taken: Intake, views: Views) -> list[str]:
    """What the user should know about a capture and the set that came of it."""
    return [*taken.notes, *warnings_about(views, inverted_masks=taken.inverted_masks)]


def _with_films(frames: list[Frame], desk: Desk) -> tuple[list[Frame], list[Skipped]]:
    """The frames with films replaced by their frames, and films that are not used."""
    out: list[Frame] = []
    skipped: list[Skipped] = []
    films = {frame.path for frame in frames if sniff(frame.path) == "video"}
    stills = {f.path.with_suffix(""): f.source for f in frames if f.path not in films}
    for number, frame in enumerate(frames):
        if frame.path not in films:
            out.append(frame)
        elif still := stills.get(frame.path.with_suffix("")):
            skipped.append(Skipped(frame.source, f"the film of the live photo {still}", True))
        else:
            try:
                out += _frames_of(frame, desk.scratch / f"film_{number}", desk)
            except CaptureError as error:
                skipped.append(Skipped(frame.source, str(error)))
    return out, skipped


def _frames_of(film: Frame, folder: Path, desk: Desk) -> list[Frame]:
    taken = take_frames(
        film.path,
        folder,
        count=desk.video_frames,
        side=max(desk.max_side, desk.placing_side),
        stop=desk.stop,
        progress=lambda label, done, total: _tell(desk, label, done, total),
    )
    stem, dot, suffix = film.source.rpartition(".")
    return [
        Frame(path, source=f"{stem or suffix}_f{number:05d}{dot}{suffix if stem else ''}")
        for number, path in taken
    ]


def _tell(desk: Desk, label: str, done: int, total: int | None) -> None:
    desk.progress(label, done, total)
