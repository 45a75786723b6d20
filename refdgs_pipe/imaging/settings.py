"""How photos are read, as the user may choose."""

from typing import Literal

from pydantic import Field, field_validator

from refdgs_pipe.params import Params


class IngestParams(Params):
    """How photos are read."""

    max_side: int = Field(
        1600, ge=64, le=16384, description="longer photos are reduced to this long side, in pixels"
    )
    placing_side: int = Field(
        1600, ge=64, le=16384, description="least long side for structure from motion, in pixels"
    )
    video_frames: int = Field(
        80, ge=3, le=2000, description="frames taken of a video at most, a count"
    )
    holdout: int = Field(
        8, ge=0, le=1000, description="hold out every n-th of 16 or more photos, a count; 0: none"
    )
    split: Literal["auto", "nero", "every8"] = Field(
        "auto", description="held out: auto, as the data set says, else by holdout; nero; every8"
    )
    chart: Literal["auto", "off"] = Field("auto", description="correct by a colour chart in sight")

    @field_validator("holdout")
    @classmethod
    def _leaves_photos(cls, holdout: int) -> int:
        if holdout == 1:
            raise ValueError("0, for none, or at least 2: 1 leaves no photo to train on")
        return holdout
