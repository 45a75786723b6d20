"""Read the user's photos, whatever they are, into one uniform folder."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Skipped, View, Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class IngestParams(Params):
    """How photos are read."""

    max_side: int = Field(
        1600, ge=64, le=16384, description="longer photos are reduced to this long side, in pixels"
    )
    holdout: int = Field(
        8, ge=0, le=1000, description="hold out every n-th of 16 or more photos, a count; 0: none"
    )
    split: Literal["auto", "nero", "every8"] = Field(
        "auto", description="held out: auto, as the data set says, else by holdout; nero; every8"
    )


@stage(version=3, programs=("opencv-contrib-python-headless", "pillow", "rawpy"))
def ingest(capture: Capture, params: IngestParams, job: Job) -> Views:
    """Decode, turn upright, mask and measure every photo."""
    from refdgs_pipe.datasets.readers import read_capture
    from refdgs_pipe.imaging.gather import gather_views, warnings_about
    from refdgs_pipe.imaging.masks import with_masks
    from refdgs_pipe.imaging.photos import plan_set, prepare_set

    layout = capture.layout()
    found = read_capture(layout, params.split)
    plan, frames, unread = plan_set(
        with_masks(found.frames, layout.masks), max_side=params.max_side
    )
    results: list[View | Skipped] = [*found.skipped, *unread]
    for done, result in enumerate(prepare_set(frames, job.folder, plan, threads=job.threads)):
        job.progress("reading photos", done, len(frames))
        results.append(result)
    views = gather_views(
        results,
        frames,
        folder=job.folder,
        linear=plan.linear,
        holdout=params.holdout if found.may_hold_out else 0,
        from_first=found.from_first,
        points=found.points,
    )
    for note in (*found.notes, *warnings_about(views, inverted_masks=plan.inverted_masks)):
        job.warn(note)
    job.measure("photos", len(views.items))
    job.measure("skipped", sum(not file.harmless for file in views.skipped))
    job.measure("colour space", views.color_space)
    job.measure("background", views.background)
    return views
