"""Bring an asset into Blender: the mesh, the light as the world, the cameras of the photos."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
from mathutils import Matrix

from .cameras import FILM_MM, PhotoCamera, read_cameras
from .errors import AddonError
from .workspace import Asset, Picture, pictures

# The centre of environment.hdr shows the asset's +Z, which is Blender's -Y. The centre of a
# picture of Blender's is +X. So the direction is turned by a quarter before it is looked up.
TURN = math.pi / 2
CAMERA_SIZE = 0.1  # of the drawn camera, in units of the mean distance to the origin


@dataclass(frozen=True)
class Wanted:
    """What to bring in."""

    asset: bool = True
    light: bool = True
    cameras: bool = True


def bring_in(context: Any, asset: Asset, wanted: Wanted) -> str:
    """Bring an asset into a new collection. Return in words what arrived.

    Raises:
        AddonError: nothing is wanted, or a file cannot be read. What arrived before stays.
    """
    if not (wanted.asset or wanted.light or wanted.cameras):
        raise AddonError("Nothing is chosen. Choose the asset, the light or the cameras")
    arrived: list[str] = []
    missing: list[str] = []
    collection = bpy.data.collections.new(asset.name)
    context.scene.collection.children.link(collection)
    try:
        if wanted.asset:
            _bring_mesh(context, asset, collection)
            arrived.append("asset")
        if wanted.light:
            if asset.light is not None:
                context.scene.world = world_of(asset)
            (arrived if asset.light else missing).append("light")
        if wanted.cameras:
            count = _bring_cameras(context, asset, collection)
            (arrived if count else missing).append(f"{count} cameras" if count else "cameras")
    finally:
        if not collection.all_objects:
            bpy.data.collections.remove(collection)
    words = f"Imported from {asset.root.name}: {', '.join(arrived) or 'nothing'}"
    return f"{words}. Not there: {', '.join(missing)}" if missing else words


def world_of(asset: Asset) -> Any:
    """A new world that shows the asset's light, in the asset's frame.

    Raises:
        AddonError: the picture cannot be read.
    """
    if asset.light is None:
        raise AddonError(f"{asset.root}: it has no environment.hdr (the recipe matte makes none)")
    image = _loaded(str(asset.light))
    world = bpy.data.worlds.new(f"{asset.name} light")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    place, turn, picture, light, out = (
        nodes.new(kind)
        for kind in (
            "ShaderNodeTexCoord",
            "ShaderNodeMapping",
            "ShaderNodeTexEnvironment",
            "ShaderNodeBackground",
            "ShaderNodeOutputWorld",
        )
    )
    for column, node in enumerate((place, turn, picture, light, out)):
        node.location = (250 * column, 0)
    turn.vector_type = "POINT"
    turn.inputs["Rotation"].default_value = (0.0, 0.0, TURN)
    picture.image, picture.projection = image, "EQUIRECTANGULAR"
    links.new(place.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], light.inputs["Color"])
    links.new(light.outputs["Background"], out.inputs["Surface"])
    return world


def _bring_mesh(context: Any, asset: Asset, collection: Any) -> None:
    """Import the GLB and move what came into the collection.

    Raises:
        AddonError: Blender's import of glTF is switched off, or it refuses the file.
    """
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    before = set(bpy.data.objects)
    _try(lambda: bpy.ops.import_scene.gltf(filepath=str(asset.glb)), str(asset.glb))
    for thing in set(bpy.data.objects) - before:
        for holder in list(thing.users_collection):
            holder.objects.unlink(thing)
        collection.objects.link(thing)


def _bring_cameras(context: Any, asset: Asset, collection: Any) -> int:
    """Add the cameras of the photos, with the photos behind them. Return how many.

    The scene then looks through the first one, and its pictures get the size of that camera's
    photo: with another shape of picture the mesh would not lie over the photos.

    Raises:
        AddonError: scene.usda cannot be read.
    """
    found = read_cameras(asset.scene) if asset.scene else []
    if not found:
        return 0
    below = bpy.data.collections.new(f"{asset.name} cameras")
    collection.children.link(below)
    photos = pictures(asset.root)
    distance = sum(math.hypot(*(row[3] for row in one.pose[:3])) for one in found) / len(found)
    made = []
    for one in found:
        thing = camera_of(one, photos.get(one.name))
        thing.data.display_size = max(CAMERA_SIZE * distance, 1e-4)
        below.objects.link(thing)
        made.append(thing)
    context.scene.camera = made[0]
    _size_pictures(context.scene, found[0], photos.get(found[0].name))
    return len(made)


def camera_of(camera: PhotoCamera, photo: Picture | None) -> Any:
    """A new object for a camera; it is in no collection yet."""
    name = photo.name if photo else camera.name
    data = bpy.data.cameras.new(name)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width, data.sensor_height = FILM_MM, FILM_MM * camera.aspect
    data.lens = camera.lens_mm
    data.shift_x, data.shift_y = camera.shift_x, camera.shift_y
    thing = bpy.data.objects.new(name, data)
    thing.matrix_world = Matrix(camera.pose)
    distance = math.hypot(*(row[3] for row in camera.pose[:3]))
    data.clip_start, data.clip_end = max(distance / 1000, 1e-5), max(1000 * distance, 100.0)
    if photo is not None:
        behind = data.background_images.new()
        behind.image = _loaded(str(photo.path))
        behind.frame_method = "STRETCH"
        data.show_background_images = True
    return thing


def _size_pictures(scene: Any, camera: PhotoCamera, photo: Picture | None) -> None:
    """Give the scene's pictures the shape of a photo; its size too, if it is known."""
    width = photo.width if photo else 1024
    height = photo.height if photo else max(1, round(width * camera.aspect))
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0


def _loaded(path: str) -> Any:
    """A picture of Blender's.

    Raises:
        AddonError: Blender cannot read it.
    """
    return _try(lambda: bpy.data.images.load(path, check_existing=True), path)


def _try(act: Callable[[], Any], path: str) -> Any:
    """Let Blender read a file.

    Raises:
        AddonError: it refuses.
    """
    try:
        return act()
    except (RuntimeError, AttributeError) as error:
        why = " ".join(str(error).split())
        raise AddonError(
            f"{path}: Blender did not read it ({why}). Check that the add-on glTF 2.0 is on, "
            "or make the asset again"
        ) from None
