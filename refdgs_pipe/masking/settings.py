"""Settings of the stage `masks`."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.params import Params


class MasksParams(Params):
    """Masks that are made from the photos themselves."""

    find: Literal["auto", "off"] = Field(
        "auto", description="auto: where the photos have none and all agree on one; or off"
    )
    agreement: float = Field(
        0.9,
        ge=0,
        le=1,
        description="masks that agree less with the solid that all of them show are not used "
        "(intersection over union)",
    )
