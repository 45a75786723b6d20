"""Run by Blender's Python: import a file and print as JSON what arrived.

Arguments: FILE, or FILE "frames", or FILE DIRECTION...

With "frames" the tangents that Blender itself makes of the mesh (MikkTSpace) are printed too.

With a direction (x y z, of the asset: +Y up) a camera in the origin looks there, and the light that
it sees is printed too.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector


def load(path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")  # dome lights are put into it
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.wm.usd_import(filepath=str(path))


def described() -> dict[str, Any]:
    """The one mesh, its material and its textures."""
    (mesh,) = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    bpy.context.view_layer.update()
    corners = [mesh.matrix_world @ vertex.co for vertex in mesh.data.vertices]
    bounds = [[pick(c[i] for c in corners) for i in range(3)] for pick in (min, max)]
    (material,) = [slot.material for slot in mesh.material_slots]
    spaces = {}
    for node in material.node_tree.nodes:
        if node.type == "TEX_IMAGE":
            spaces[Path(node.image.filepath or node.image.name).stem] = (
                node.image.colorspace_settings.name
            )
    surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    linked = [socket.name for socket in surface.inputs if socket.is_linked]
    return {
        "bounds": bounds,
        "faces": len(mesh.data.polygons),
        "uv_sets": len(mesh.data.uv_layers),
        "custom_normals": bool(mesh.data.has_custom_normals),
        "spaces": spaces,
        "linked": linked,
        "cameras": sorted(o.name for o in bpy.data.objects if o.type == "CAMERA"),
    }


def frames() -> list[list[float]]:
    """For each corner of a face: vertex, its place, tangent, sign of the bitangent."""
    (mesh,) = [thing.data for thing in bpy.data.objects if thing.type == "MESH"]
    mesh.calc_tangents()
    return [
        [
            corner.vertex_index,
            *mesh.vertices[corner.vertex_index].co,
            *corner.tangent,
            corner.bitangent_sign,
        ]
        for corner in mesh.loops
    ]


def light_from(direction: tuple[float, float, float]) -> float:
    """Mean linear radiance that a camera in the origin sees there, the mesh left out."""
    return sum(light_of(direction)) / 3


def light_of(direction: tuple[float, ...]) -> list[float]:
    """The same for red, green and blue."""
    x, y, z = direction
    toward = Vector((x, -z, y))  # Blender has z up
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    data = bpy.data.cameras.new("eye")
    data.angle = 0.3
    eye = bpy.data.objects.new("eye", data)
    eye.matrix_world = Matrix(toward.to_track_quat("-Z", "Y").to_matrix().to_4x4())
    scene = bpy.context.scene
    scene.collection.objects.link(eye)
    scene.camera = eye
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 4
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    target = Path(bpy.app.tempdir) / "light.exr"
    scene.render.filepath = str(target)
    bpy.ops.render.render(write_still=True)
    pixels = list(bpy.data.images.load(str(target)).pixels)
    return [sum(pixels[i::4]) / (len(pixels) / 4) for i in range(3)]


if __name__ == "__main__":
    names = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    load(Path(names[0]))
    record = described()
    if names[1:] == ["frames"]:
        record["frames"] = frames()
    elif len(names) > 1:
        sides = [tuple(float(x) for x in name.split(",")) for name in names[1:]]
        record["light"] = [light_from(side) for side in sides]  # type: ignore[arg-type]
    print("\nRECORD", json.dumps(record), flush=True)
    os._exit(0)  # bpy 4.2 as a module crashes at its end once its import of glTF was used
