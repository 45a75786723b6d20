"""The program refdgs-pipe: where it is, and the command lines that it gets. No bpy here.

Every command is a list of arguments. No shell reads it, so a file name is never a command.
"""

import json
import math
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from .errors import AddonError
from .workspace import absolute

NAME = "refdgs-pipe"
PLACES = ("", "bin", ".venv/bin")  # below a folder that the user names
ASK_S = 60.0  # a question such as `recipe list` may take so long on a busy machine


@dataclass(frozen=True)
class Recipe:
    """A recipe: its name, and what it is for."""

    name: str
    about: str


# While the program was not asked, or cannot be asked.
KNOWN = (
    Recipe("glossy", "For shiny objects: metal, glaze, lacquer, glossy plastic"),
    Recipe("detail", "For small print and fine patterns; it takes more time and memory"),
    Recipe("matte", "For objects that do not reflect: cloth, stone, raw wood"),
    Recipe("preview", "For a first look within minutes"),
)


@dataclass(frozen=True)
class Order:
    """What the user wants made.

    Args:
        photos: an absolute path: a folder of photos, a ZIP, a video, or a workspace.
        workspace: the folder for the results; "" leaves the choice to the program.
        recipe: its name; "" takes what the workspace remembers, else the program's default.
        size_m: the longest side of the object in metres; 0 if it is not known.
    """

    photos: str
    workspace: str = ""
    recipe: str = ""
    size_m: float = 0.0


def find(chosen: str) -> Path:
    """The program's file: the chosen one, or the first on the PATH if none was chosen.

    Args:
        chosen: a file, or a folder that has it (a virtual environment, or a clone with `.venv`).

    Raises:
        AddonError: it is not there, or this user may not run it.
    """
    if not chosen:
        found = shutil.which(NAME)
        if found is None:
            raise AddonError(
                f"{NAME} is not on the PATH. Set its path in the preferences of this add-on; "
                f"in a clone it is .venv/bin/{NAME}"
            )
        return absolute(found)
    path = absolute(chosen)
    tries = [path / place / NAME for place in PLACES] if path.is_dir() else [path]
    program = next((file for file in tries if file.is_file()), None)
    if program is None:
        raise AddonError(
            f"{path}: the program {NAME} is not there. Set its path in the preferences of this "
            f"add-on; in a clone it is .venv/bin/{NAME}"
        )
    if not os.access(program, os.X_OK):
        raise AddonError(
            f"{program}: this file may not be run. Choose the program {NAME} in the preferences "
            "of this add-on"
        )
    return program


def run_command(program: Path, order: Order) -> list[str]:
    """The arguments of a run, which prints one JSON object at its end.

    Raises:
        AddonError: there are no photos at that place, or the size is no length.
    """
    if not order.photos:
        raise AddonError("No photos are chosen. Choose a folder of photos")
    photos = absolute(order.photos)
    if not photos.exists():
        raise AddonError(f"{photos}: there is nothing. Choose a folder of photos")
    if not (math.isfinite(order.size_m) and order.size_m >= 0):
        raise AddonError(f"Longest side {order.size_m}: give metres, or 0 if it is not known")
    command = [str(program), "run", "--json"]
    if order.recipe:
        command += ["--recipe", order.recipe]
    if order.workspace:
        command += ["--workspace", str(absolute(order.workspace))]
    if order.size_m:
        command += ["--size", f"{order.size_m:.6g}"]
    return [*command, "--", str(photos)]


def environment() -> dict[str, str]:
    """The variables that the program gets: without those that are meant for Blender's Python."""
    return {name: text for name, text in os.environ.items() if not name.startswith("PYTHON")}


def recipes(program: Path) -> tuple[Recipe, ...]:
    """The recipes of that program, without the controls for experiments. It takes some seconds.

    Raises:
        AddonError: it cannot be asked, or its answer is not understood.
    """
    command = [str(program), "recipe", "list", "--json"]
    try:
        answer = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=ASK_S,
            check=True,
            env=environment(),
        ).stdout
        listed = json.loads(answer)["recipes"]
        found = tuple(Recipe(str(one["name"]), str(one["about"])) for one in listed)
    except (OSError, subprocess.SubprocessError, ValueError, TypeError, KeyError) as error:
        raise AddonError(f"{program} did not list its recipes: {error}") from None
    return tuple(one for one in found if not one.name.startswith("paper")) or KNOWN
