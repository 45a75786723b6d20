"""refdgs-pipe in Blender: photos in, textured mesh, light and cameras out.

This file only registers the classes. docs/blender.md says how the add-on is used.
"""

import bpy

from . import panel, running, settings

CLASSES = (
    settings.RefdgsPreferences,
    settings.RefdgsSettings,
    panel.RefdgsRun,
    panel.RefdgsStop,
    panel.RefdgsImport,
    panel.RefdgsTell,
    panel.RefdgsPanel,
)


def register() -> None:
    """Called by Blender when the add-on is switched on."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.refdgs_pipe = bpy.props.PointerProperty(type=settings.RefdgsSettings)


def unregister() -> None:
    """Called by Blender when the add-on is switched off, and when Blender closes."""
    running.leave()
    del bpy.types.Scene.refdgs_pipe
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
