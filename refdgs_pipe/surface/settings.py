"""Settings of the stages that make a mesh of a field."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from refdgs_pipe.params import Params


class FusionParams(Params):
    """Fusion of depth maps"""

    voxel: float = Field(
        0.004, ge=0.0008, le=0.05, description="edge of a voxel, in diameters of the object ball"
    )
    band: float = Field(
        4.0, ge=2, le=16, description="half-width of the signed-distance band, in voxels"
    )
    min_alpha: float = Field(
        0.5, ge=0, le=1, description="pixels with less opacity are ignored (share)"
    )
    min_views: int = Field(
        2, ge=1, le=50, description="views that must see a place before it becomes surface, a count"
    )
    pixels: int = Field(
        960, ge=64, le=8192, description="longest side of the depth maps, in pixels"
    )


class RepairParams(Params):
    """Repair"""

    floater: float = Field(
        0.08,
        ge=0,
        le=1,
        description="loose pieces smaller than this are removed, in ball diameters",
    )
    hole: float = Field(
        0.15, ge=0, le=10, description="holes with a shorter rim are closed, in ball diameters"
    )
    smoothing: int = Field(5, ge=0, le=200, description="smoothing steps (Taubin), a count")
    faces: int = Field(50_000, ge=100, le=5_000_000, description="most triangles, a count")

    @property
    def faces_before_walls(self) -> int:
        """Triangles at most before the fit to the views adds walls."""
        return self.faces - self.faces // 16


class FitParams(Params):
    """Fit to the views"""

    outlines: int = Field(
        3, ge=0, le=20, description="rounds of fitting the mesh to the views, a count"
    )
    flatten: bool = Field(
        True,
        description="make parts flat that outlines show to be flat; needs outlines of 1 or more",
    )


class ShapeParams(FusionParams, RepairParams, FitParams):
    """The mesh that surfels start anew on, at `train.renew_at`."""


class ExtractParams(FusionParams):
    """Fusion of depth maps on a voxel grid."""

    close: bool = Field(
        True, description="close gaps that no view sees, down to the ground below the object"
    )


class CleanParams(RepairParams):
    """Repair and simplification of the mesh."""

    renamed: ClassVar[Mapping[str, str]] = {
        "outlines": "fit.outlines",
        "flatten": "fit.flatten",
    }
    keep: Literal["object", "all"] = Field(
        "all", description="all: the whole mesh; object: without the table or plate below it"
    )
    base: Literal["open", "closed"] = Field(
        "open",
        description="closed: close the mesh where the object stands on the ground; open: do not",
    )
