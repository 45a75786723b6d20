"""What the user says about places, and what is asked of them."""

from pydantic import Field, field_validator

from refdgs_pipe.params import Params

Point = tuple[float, float, float]


class GateParams(Params):
    """What is asked of the places. A given up axis or ball is in the frame of the result."""

    min_trusted: float = Field(
        0.7, ge=0, le=1, description="least share of photos whose camera must be found and trusted"
    )
    ground: bool = Field(
        True,
        description="refine camera poses, and place lost photos, with the texture of the plane "
        "below the object",
    )
    even: bool = Field(
        True,
        description="undo differences in exposure and white balance between photos, as the plane "
        "below the object shows them",
    )
    up: Point | None = Field(None, description="up direction, in world axes; unset: found")
    ball_center: Point | None = Field(
        None, description="object ball's centre, in world units; unset: found"
    )
    ball_radius: float | None = Field(
        None, gt=0, description="object ball's radius, in world units; unset: found"
    )
    distance: str = Field(
        "",
        max_length=2000,
        description="two points, marked in photos in pixels, and their distance in metres; "
        "empty: none",
    )

    @field_validator("up")
    @classmethod
    def _is_a_direction(cls, up: Point | None) -> Point | None:
        if up is not None and not any(up):
            raise ValueError("a direction, such as [0, 0, 1]")
        return up

    @field_validator("distance")
    @classmethod
    def _can_be_read(cls, distance: str) -> str:
        if distance:
            from refdgs_pipe.sfm.two_points import parsed

            parsed(distance)
        return distance
