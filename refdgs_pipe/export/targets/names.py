"""For what an asset can be delivered."""

from typing import Literal

Target = Literal["web", "ar", "game", "film", "print"]
FOLDER = "targets"  # of the exported files; a target's files are in FOLDER/NAME
