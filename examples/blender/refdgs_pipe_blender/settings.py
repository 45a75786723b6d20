"""What the user sets: in the panel (kept in the scene) and in the preferences."""

import threading
import zlib
from typing import Any

import bpy

from . import program
from .errors import AddonError

REMEMBERED = "REMEMBERED"  # no --recipe: what the workspace was last run with
Item = tuple[str, str, str, str, int]


class _Recipes:
    """The recipes of the program, asked for once in a thread, so that no drawing waits."""

    def __init__(self) -> None:
        self._listed: dict[str, tuple[program.Recipe, ...]] = {}
        self._asked: set[str] = set()
        self.items: list[Item] = []  # Blender needs the strings to stay alive

    def of(self, chosen: str) -> tuple[program.Recipe, ...]:
        """Those of the program with that path in the preferences; the known ones until it said."""
        if chosen not in self._asked:
            self._asked.add(chosen)
            threading.Thread(target=self._ask, args=(chosen,), daemon=True).start()
        return self._listed.get(chosen, program.KNOWN)

    def _ask(self, chosen: str) -> None:
        try:
            self._listed[chosen] = program.recipes(program.find(chosen))
        except AddonError:
            self._listed[chosen] = program.KNOWN  # Run says what is wrong with the program


RECIPES = _Recipes()


def chosen_program(context: Any) -> str:
    """The path in the preferences; "" if none is set."""
    addon = context.preferences.addons.get(__package__)
    path = addon.preferences.program if addon and addon.preferences else ""
    return str(bpy.path.abspath(path)) if path else ""


def recipe_items(owner: Any, context: Any) -> list[Item]:
    """The menu of recipes. A recipe has the same number in every list: files keep the number."""
    chosen = chosen_program(context) if context else ""
    as_before = "The recipe that this workspace was last run with; glossy in a new workspace"
    items: list[Item] = [(REMEMBERED, "as before", as_before, "NONE", 0)]
    for one in RECIPES.of(chosen):
        number = 1 + zlib.crc32(one.name.encode()) % (1 << 30)
        items.append((one.name, one.name, one.about, "NONE", number))
    if items != RECIPES.items:
        RECIPES.items = items
    return RECIPES.items


class RefdgsPreferences(bpy.types.AddonPreferences):
    """The preferences of the add-on."""

    bl_idname = __package__
    __annotations__ = {
        "program": bpy.props.StringProperty(
            name="Program",
            description="The file refdgs-pipe, or the folder of its environment or clone. "
            "Empty: the one on the PATH",
            subtype="FILE_PATH",
        )
    }

    def draw(self, context: Any) -> None:
        """One field, and whether the program is there."""
        self.layout.prop(self, "program")
        try:
            self.layout.label(text=str(program.find(chosen_program(context))), icon="CHECKMARK")
        except AddonError as error:
            self.layout.label(text=str(error), icon="ERROR")


class RefdgsSettings(bpy.types.PropertyGroup):
    """What a scene asks for."""

    __annotations__ = {
        "photos": bpy.props.StringProperty(
            name="Photos",
            description="A folder of photos. You can also type the path of a ZIP or a video",
            subtype="DIR_PATH",
        ),
        "workspace": bpy.props.StringProperty(
            name="Workspace",
            description="Folder for the results. Empty: PHOTOS.refdgs beside the photos",
            subtype="DIR_PATH",
        ),
        "recipe": bpy.props.EnumProperty(
            name="Recipe", description="How the asset is made", items=recipe_items
        ),
        "size": bpy.props.FloatProperty(
            name="Longest side",
            description="Of the object, in metres. 0: not known, or as before",
            min=0.0,
            max=1000.0,
            precision=3,
            step=1,
        ),
        "asset": bpy.props.BoolProperty(name="Asset", default=True),
        "light": bpy.props.BoolProperty(
            name="Light", description="The light around the object, as the world", default=True
        ),
        "cameras": bpy.props.BoolProperty(
            name="Cameras", description="The cameras of the photos", default=True
        ),
    }


def order_of(settings: Any) -> program.Order:
    """What the panel asks for, with absolute paths."""
    recipe = str(settings.recipe)
    return program.Order(
        photos=typed(settings.photos),
        workspace=typed(settings.workspace),
        recipe="" if recipe in ("", REMEMBERED) else recipe,
        size_m=float(settings.size),
    )


def typed(path: str) -> str:
    """A path of the panel; "//" begins one beside the Blender file. "" stays ""."""
    return str(bpy.path.abspath(path)) if path else ""
