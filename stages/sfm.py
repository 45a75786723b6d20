"""Find where every photo was taken."""

from functools import partial
from typing import Any, Literal

from pydantic import Field

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class SfmParams(Params):
    """Structure from motion."""

    max_side: int = Field(1600, ge=100, le=16384, description="largest long side, in pixels")
    max_features: int = Field(8192, ge=100, le=65536, description="features per photo at most")
    first_octave: int | None = Field(
        None, ge=-1, le=2, description="-1: enlarge photos twofold; unset: if below 1000 pixels"
    )
    masks: Literal["auto", "object", "background", "none"] = Field(
        "auto", description="use features of: object, background, none (all); auto: try in turn"
    )
    mat_line: float = Field(
        180.0, ge=90, le=360, description="printed mat's ruler line as measured, in millimetres"
    )


@stage(version=11, programs=("pycolmap",))
def sfm(views: Views, params: SfmParams, job: Job) -> Placement:
    """Place the photos, in harder ways where easier ones leave some out."""
    from refdgs_pipe.child_process import ChildCrashed, call_in_child
    from refdgs_pipe.sfm.known import needs_points, posed_photos, without_points
    from refdgs_pipe.sfm.pictures import plain_images
    from refdgs_pipe.sfm.poses import Effort
    from refdgs_pipe.sfm.solve import solve

    def run(arguments: dict[str, Any], what: str = "colmap:reconstruct") -> Any:
        target = f"refdgs_pipe.sfm.{what}"
        return call_in_child(target, arguments, stop=job.stop, on_progress=job.progress)

    effort = Effort(params.max_side, params.max_features, params.first_octave, job.threads)
    if views.has_known_poses:
        poses = None
        if needs_points(views):
            try:
                poses = run(posed_photos(views, effort, job.scratch), "sights:triangulate")
            except (ChildCrashed, ImportError, RuntimeError) as error:
                job.warn(without_points(error))
        return Placement(poses, known=True)
    pictures = plain_images(views, job.scratch)
    told = partial(job.progress, "comparing the ground")
    given: dict[str, Any] = {"masks": params.masks, "line_mm": params.mat_line, "told": told}
    placement = solve(views, pictures, effort, scratch=job.scratch, run=run, **given)
    for attempt in placement.attempts:
        found = f"{attempt.placed} placed, {attempt.trusted} trusted, {attempt.points} points"
        job.measure(attempt.name, found)
    return placement
