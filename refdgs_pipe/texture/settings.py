"""Settings of the stages `appearance` and `bake`."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.params import Params, PowerOfTwo

PAINTED_SIDE = 2048  # texels along a side: before fine detail, larger textures are not painted


class AppearanceParams(Params):
    """The fit of materials and light to what the field shows."""

    metal: Literal["tell", "none"] = Field(
        "tell", description="tell: find metal by how reflections vary; none: no metal"
    )
    samples: int = Field(
        300_000, ge=1000, le=20_000_000, description="samples of the surface, a count"
    )
    light: int = Field(
        64, ge=16, le=256, multiple_of=8, description="rows of the light map, in texels"
    )
    tolerance: float = Field(
        0.01, gt=0, le=0.2, description="largest gap of mesh and field, in ball diameters"
    )


class BakeParams(Params):
    """The textures."""

    size: PowerOfTwo = Field(
        2048, ge=64, le=8192, description="texels along a side; a power of two"
    )
    tolerance: float = Field(
        0.01, gt=0, le=0.2, description="largest gap of mesh and field, in ball diameters"
    )
    refine: bool = Field(True, description="correct base colours by the photos, in the light found")
    detail: bool = Field(False, description="take fine detail of base colours from the photos")

    @property
    def painted_size(self) -> int:
        """Texels along a side of what is painted from the field."""
        return min(self.size, PAINTED_SIDE) if self.detail else self.size
