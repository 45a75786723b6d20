"""Settings of the stage `lighting`."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.params import Params


class LightingParams(Params):
    """How the light moves while the photos are taken."""

    kind: Literal["auto", "world", "turntable", "flash", "world+flash"] = Field(
        "auto",
        description="how the light moves. auto: as the photos show; world: light and object stand "
        "still; turntable: the object turns in a room that stands still; flash: a lamp on the "
        "camera in a dark room; world+flash: a lamp on the camera in a bright room",
    )
