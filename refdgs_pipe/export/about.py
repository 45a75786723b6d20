"""What every exported file says about itself."""

from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import TypeAlias

from refdgs_pipe import __version__

About: TypeAlias = dict[str, str | float | list[str]]
GENERATOR = f"refdgs-pipe {__version__}"


def about_asset(recipe: str, sources: Iterable[str], metres_per_unit: float, scale: str) -> About:
    """The metadata of an asset: texts, numbers and lists of texts. No folder is named.

    Args:
        recipe: its name; empty if it has none.
        sources: the photos, as they are called in the capture.
        metres_per_unit: of the workspace's world.
        scale: what tells that: "given", "known from the capture" or "unknown".
    """
    return {
        "tool": "refdgs-pipe",
        "version": __version__,
        "recipe": PurePosixPath(recipe).name.removesuffix(".toml"),
        "photos": [PurePosixPath(source).name for source in sources],
        "unit": "metre",
        "up": "+Y",
        "scale": scale,
        "metres_per_world_unit": metres_per_unit,
        "normals": "MikkTSpace",
        "base_color": "free of reflections",
    }
