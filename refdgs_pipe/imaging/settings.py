"""How photos are read, as the user may choose."""

from typing import Literal

from pydantic import Field, field_validator

from refdgs_pipe.params import Params


class IngestParams(Params):
    """How photos are read."""

    max_side: int = Field(
        1600, ge=64, le=16384, description="larger photos are reduced to this long side, in pixels"
    )
    placing_side: int = Field(
        1600,
        ge=64,
        le=16384,
        description="long side of photos for structure from motion, if above max_side, in pixels",
    )
    video_frames: int = Field(
        80, ge=3, le=2000, description="most frames taken from a video, a count"
    )
    holdout: int = Field(
        8,
        ge=0,
        le=1000,
        description="hold out every n-th photo if there are 16 or more; 0: hold out none",
    )
    split: Literal["auto", "nero", "every8"] = Field(
        "auto",
        description="which photos are held out. auto: as the data set says, else by "
        "ingest.holdout; nero: NeRO's 32 views; every8: every eighth",
    )
    chart: Literal["auto", "off"] = Field(
        "auto", description="auto: correct colours if a photo shows a colour chart; off: never"
    )

    @field_validator("holdout")
    @classmethod
    def _leaves_photos(cls, holdout: int) -> int:
        if holdout == 1:
            raise ValueError("0, for none, or at least 2: 1 leaves no photo to train on")
        return holdout
