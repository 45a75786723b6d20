"""The files that come out, as the user may choose."""

from pydantic import Field, PositiveInt, field_validator

from refdgs_pipe.export.targets.names import Target
from refdgs_pipe.params import Params


class ExportParams(Params):
    """The files that come out."""

    longest: float | None = Field(
        None, gt=0, le=10_000, description="the object's longest side, in metres"
    )
    targets: tuple[Target, ...] = Field(
        (), description="also write files for these uses: web, ar, game, film, print"
    )
    lods: tuple[PositiveInt, ...] = Field(
        (), description="also write GLBs with these numbers of triangles"
    )
    preview: int = Field(480, ge=64, le=4096, description="side of each preview picture, in pixels")
    environment: int = Field(512, ge=16, le=4096, description="rows of environment.hdr, in pixels")
    recipe: str = Field(
        "",
        max_length=200,
        description="recipe's name as the files note it; empty: the recipe in use",
    )

    @field_validator("targets", mode="before")
    @classmethod
    def _as_words(cls, targets: object) -> object:
        """`web,game` and `[web, game]` are what `--set` hands on for names without quotes."""
        return (
            targets.strip(" []").replace(",", " ").split() if isinstance(targets, str) else targets
        )

    @field_validator("targets")
    @classmethod
    def _once_each(cls, targets: tuple[Target, ...]) -> tuple[Target, ...]:
        return tuple(dict.fromkeys(targets))
