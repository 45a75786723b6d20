"""Read the user's photos, whatever they are, into one uniform folder."""

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.imaging.settings import IngestParams
from refdgs_pipe.pipeline.stage import Job, stage


@stage(version=6, programs=("opencv-contrib-python-headless", "pillow", "rawpy", "pi-heif"))
def ingest(capture: Capture, params: IngestParams, job: Job) -> Views:
    """Decode, turn upright, mask and measure every photo."""
    from refdgs_pipe.datasets.readers import read_capture
    from refdgs_pipe.imaging.chart import chart_figures
    from refdgs_pipe.imaging.gather import figures_of, gather_views
    from refdgs_pipe.imaging.intake import Desk, notes_on, take_in

    layout = capture.opened(job.scratch).layout()
    found = read_capture(layout, params.split)
    sizes = (params.max_side, params.placing_side, params.video_frames)
    desk = Desk(job.folder, job.scratch, *sizes, job.threads, job.stop, job.progress)
    taken = take_in(found.frames, layout, desk)
    views = gather_views(
        [*found.skipped, *taken.results],
        taken.frames,
        folder=job.folder,
        linear=taken.linear,
        holdout=params.holdout if found.may_hold_out else 0,
        from_first=found.from_first,
        points=found.points,
    )
    for note in (*found.notes, *notes_on(taken, views)):
        job.warn(note)
    for name, figure in (figures_of(views) | chart_figures(views, params.chart)).items():
        job.measure(name, figure)
    return views
