"""Settings of the stage `clean`."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.params import Params


class CleanParams(Params):
    """Repair and simplification of the mesh."""

    keep: Literal["object", "all"] = Field("all", description="object: no table or plate below it")
    base: Literal["open", "closed"] = Field(
        "open", description="closed: close the mesh on the ground that the object stands on"
    )
    floater: float = Field(
        0.08, ge=0, le=1, description="smaller loose pieces are removed, in ball diameters"
    )
    hole: float = Field(0.15, ge=0, le=10, description="shorter rims are closed, in ball diameters")
    smoothing: int = Field(5, ge=0, le=200, description="smoothing steps (Taubin), a count")
    outlines: int = Field(3, ge=0, le=20, description="fits of the mesh to its views, a count")
    flatten: bool = Field(
        True, description="make flat what outlines show to be flat; with clean.outlines above 0"
    )
    faces: int = Field(50_000, ge=100, le=5_000_000, description="the most triangles, a count")
