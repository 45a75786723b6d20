"""Cut the mesh into charts and pack them in a square atlas."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.mesh import Mesh, UvMesh
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class UnwrapParams(Params):
    """The atlas."""

    backend: Literal["auto", "uvatlas", "xatlas"] = Field(
        "auto", description="program to prefer; auto: the first good atlas, else the better one"
    )
    gutter: float = Field(
        4.0, ge=0.5, le=64, description="space between charts, in 1/1024 of the atlas's side"
    )
    stretch: float = Field(
        0.1667, ge=0, le=1, description="stretch allowed before a chart is cut; 0: none, 1: any"
    )
    timeout: float = Field(
        300.0, gt=0, le=36_000, description="seconds for each program before the next is tried"
    )


@stage(version=4, programs=("open3d-cpu", "xatlas"))
def unwrap(mesh: Mesh, params: UnwrapParams, job: Job) -> UvMesh:
    """Give every face its place in the atlas."""
    from refdgs_pipe.texture import charts

    job.progress("unwrapping", 0, None)
    done = charts.unwrap(
        mesh,
        gutter=params.gutter / 1024,
        max_stretch=params.stretch,
        timeout_s=params.timeout,
        backend=params.backend,
        stop=job.stop,
    )
    layout = done.layout
    job.measure("program", layout.method)
    job.measure("charts", layout.charts)
    job.measure("atlas used", round(layout.used, 3))
    job.measure("stretch", round(layout.stretch, 3))
    if len(done.tried) > 1:
        tried = (f"{one.method} {one.worth:.2f}" for one in done.tried)
        job.measure("worth of those tried", ", ".join(tried))
    if done.refused:
        job.warn(f"charts are by {layout.method}, because: {'; '.join(done.refused)}")
    return done.mesh
