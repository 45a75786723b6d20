"""Run by Blender's Python: install the add-on from its ZIP, use it, print as JSON what happened.

Arguments: ZIP TASKS, where TASKS is a JSON file:

    program, photos, workspace: for the preferences and the panel
    run: [recipe, size], the run to make first; stop: true to press Stop once it has progress
    close: true to switch all add-ons off, as Blender does when it closes, instead of waiting
    bring_in: true to import
    sizes: camera -> [width, height] of its photo, pixels; corners of the mesh are projected
    directions: [[x, y, z], ...] of the asset (+Y up): the light that comes from there is drawn

Before `bpy` is imported, BLENDER_USER_RESOURCES must name an empty folder.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import bpy
from bpy_extras.object_utils import world_to_camera_view

MODULE = "bl_ext.user_default.refdgs_pipe_blender"
DEADLINE_S = 60.0


def install(archive: str) -> None:
    """As the user does it: Preferences, Get Extensions, Install from Disk."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )


def run(tasks: dict[str, Any]) -> dict[str, Any]:
    """Press Run, look at it as Blender's timer does, and perhaps press Stop."""
    running = sys.modules[f"{MODULE}.running"]
    settings = bpy.context.scene.refdgs_pipe
    settings.recipe, settings.size = tasks["run"]
    pressed = press(bpy.ops.refdgs_pipe.run)
    record = {"pressed": pressed, "ticking": bpy.app.timers.is_registered(running.tick)}
    if running.STATE.job is None:
        return record | {"error": running.STATE.error}
    record["second"] = press(bpy.ops.refdgs_pipe.run)
    words, drawn, end, stopped = set(), set(), time.monotonic() + DEADLINE_S, False
    while time.monotonic() < end and running.tick() is not None:
        words.add(running.STATE.job.progress.words)
        drawn |= panel_words()
        if "train: training, 10 of 40" in words and tasks.get("close"):
            import addon_utils  # there once bpy is

            addon_utils.disable_all()
            return record | {"words": sorted(words)}
        if "train: training, 10 of 40" in words and tasks.get("stop") and not stopped:
            press(bpy.ops.refdgs_pipe.stop)
            stopped = True
        time.sleep(0.05)
    state = running.STATE
    drawn |= panel_words()
    record |= {"words": sorted(words), "drawn": sorted(drawn)}
    return record | {"error": state.error, "result": state.result}


def panel_words() -> set[str]:
    """The labels, buttons and fields that the panel draws now. No window shows them here."""
    drawn, panel = MagicMock(), sys.modules[f"{MODULE}.panel"].RefdgsPanel
    panel.draw(drawn, bpy.context)
    fields = bpy.context.scene.refdgs_pipe.bl_rna.properties
    found = set()
    for name, arguments, named in drawn.layout.mock_calls:
        kind = name.rpartition(".")[2]
        if kind == "label":
            found.add(named["text"])
        elif kind == "operator":
            found.add(arguments[0])
        elif kind == "prop":
            found.add(fields[arguments[1]].name)
    return found


def press(button: Any) -> str:
    """What a button answers: "FINISHED", or the error that it reports."""
    try:
        (answer,) = button()
    except RuntimeError as error:
        return str(error)
    return str(answer)


def bring_in(tasks: dict[str, Any]) -> dict[str, Any]:
    """Press Import, and say what is there."""
    record: dict[str, Any] = {"pressed": press(bpy.ops.refdgs_pipe.bring_in)}
    state = sys.modules[f"{MODULE}.running"].STATE
    record |= {"error": state.error, "result": state.result}
    scene = bpy.context.scene
    bpy.context.view_layer.update()
    record["collections"] = {
        one.name: sorted(f"{o.type} {o.name}" for o in one.objects) for one in bpy.data.collections
    }
    record["camera"] = scene.camera and scene.camera.name
    record["picture"] = [scene.render.resolution_x, scene.render.resolution_y]
    record["behind"] = {
        one.name: [Path(image.image.filepath).name for image in one.data.background_images]
        for one in bpy.data.objects
        if one.type == "CAMERA"
    }
    record["world"] = scene.world and scene.world.name
    if meshes := [one for one in bpy.data.objects if one.type == "MESH"]:
        corners = [meshes[0].matrix_world @ vertex.co for vertex in meshes[0].data.vertices]
        step = max(1, len(corners) // 40)
        record["corners"] = [list(corner) for corner in corners[::step]]
        record["bounds"] = [[pick(c[i] for c in corners) for i in range(3)] for pick in (min, max)]
        record["pixels"] = {
            name: projected(name, size, corners[::step])
            for name, size in tasks.get("sizes", {}).items()
        }
    return record


def projected(name: str, size: list[int], points: list[Any]) -> list[list[float]]:
    """Where Blender's camera has points in a picture, pixels from its left upper corner."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = size
    found = [world_to_camera_view(scene, bpy.data.objects[name], point) for point in points]
    return [[one.x * size[0], (1 - one.y) * size[1]] for one in found]


def main(archive: str, file: str) -> dict[str, Any]:
    """Do the tasks."""
    tasks = json.loads(Path(file).read_text("utf-8"))
    install(archive)
    addon = bpy.context.preferences.addons[MODULE]
    addon.preferences.program = tasks["program"]
    settings = bpy.context.scene.refdgs_pipe
    settings.photos, settings.workspace = tasks["photos"], tasks["workspace"]
    record: dict[str, Any] = {}
    if "run" in tasks:
        record["run"] = run(tasks)
    if tasks.get("bring_in"):
        record["import"] = bring_in(tasks)
    if tasks.get("directions"):
        sys.path.insert(0, str(Path(__file__).parent))  # Blender itself does not
        from look_in_blender import light_of

        record["light"] = [light_of(tuple(one)) for one in tasks["directions"]]
    return record


if __name__ == "__main__":
    names = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    print("\nRECORD", json.dumps(main(names[0], names[1])), flush=True)
    os._exit(0)  # bpy 4.2 as a module crashes at its end if any panel was registered
