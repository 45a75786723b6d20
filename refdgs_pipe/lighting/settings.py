"""Settings of the stage `lighting`."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.params import Params


class LightingParams(Params):
    """How the light moves while the photos are taken."""

    kind: Literal["auto", "world", "turntable", "flash", "world+flash"] = Field(
        "auto",
        description="world: it stands still with the object; turntable: the object turns in a room "
        "that stands still; flash: a lamp on the camera, in a dark room; world+flash: in a bright "
        "one; auto: what the photos show",
    )
