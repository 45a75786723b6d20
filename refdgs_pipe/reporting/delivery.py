"""The exported files for people: how large the object is, and which file to use for what."""

from collections.abc import Sequence

from refdgs_pipe.artifacts.asset import Asset, Delivery
from refdgs_pipe.formatting import size
from refdgs_pipe.reporting.dimensions import dimensions, is_size_known
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Content, Html, joined, table, tag

# for what, which files, how
_USES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("Game", ("asset.glb",), "Unity, Unreal and Godot import it with its textures and materials."),
    ("Film, rendering", ("scene.usda", "asset.usdc"), "scene.usda is the asset in the light that "
     "was found around it, with the cameras of the photos. Blender, Houdini and Maya open it."),
    ("AR", ("asset.usdz", "asset.glb"), "USDZ for iPhone and iPad, GLB for Android."),
    ("Web", ("asset.glb",), "<model-viewer>, three.js and Babylon.js show it."),
    ("Other programs", ("asset.obj",), "With asset.mtl and the folder textures, for programs that "
     "read neither glTF nor USD."),
    ("Light", ("environment.hdr",), "The light around the object, as an environment map."),
    ("Gaussian splats", ("splats.ply", "splats.usdc"), "What was trained, before the mesh."),
)  # fmt: skip

# target -> for what, how
MADE_FOR = {
    "web": ("Web", "<model-viewer>, three.js and Babylon.js show asset.glb as it is"),
    "game": ("Game", "One file for each level of detail; textures has the pictures alone"),
    "film": ("Film, rendering", "asset.usdc has OpenPBR by MaterialX beside UsdPreviewSurface"),
    "ar": ("AR", "asset.usdz for iPhone and iPad, asset.glb for Scene Viewer on Android"),
    "print": ("3D printing", "A closed body in millimetres"),
}


def size_line(facts: Facts) -> Html:
    """How large the object is, or how to tell it."""
    result, folder = facts.result(Asset), facts.folder(Asset)
    box = dimensions(folder / "asset.glb")
    if box is None or result is None:
        return Html("")
    told = str(result.measures.get("size", ("unknown", ""))[0])
    if is_size_known(told):
        how = told.partition(", ")[2]
        source = f" The size is {how}." if how else ""
        return tag("p", tag("b", box.words), f" (width x height x depth).{source}")
    words = (
        f"The real size is unknown: nothing in the photos tells it. In the files it is {box.words} "
        "(width x height x depth). To set it, give the longest side in metres: "
    )
    return tag("p", words, tag("code", "refdgs-pipe run PHOTOS --size 0.23"), ".")


def delivery(facts: Facts, _: Drawing) -> Html:
    """Where the files are, and which to use for what."""
    asset = facts.load(Asset)
    there = {file.name: file.bytes for file in asset.files}
    made = {MADE_FOR[delivery.name][0]: delivery for delivery in asset.targets}
    rows: list[tuple[Content, ...]] = []
    for use, names, how in _USES:
        found = [name for name in names if name in there]
        if use in made:
            rows.append(_made_row(made.pop(use), there))
        elif found:
            rows.append((use, _named(found, there), how))
    rows += [_made_row(delivery, there) for delivery in made.values()]
    where = tag(
        "p",
        "All files are in the folder ",
        tag("code", "asset"),
        " beside this page, in metres, +Y up, front +Z.",
    )
    head = ("for", "file", "how")
    return joined(where, table(head, rows, class_="uses"))


def _made_row(delivery: Delivery, there: dict[str, int]) -> tuple[Content, ...]:
    """The files that were made for one use."""
    use, how = MADE_FOR[delivery.name]
    words = ". ".join((how, delivery.summary[:1].upper() + delivery.summary[1:], *delivery.notes))
    return use, _named(delivery.main_files, there), f"{words}."


def _named(names: Sequence[str], there: dict[str, int]) -> Html:
    lines = [
        tag("span", tag("code", name), f" {size(there[name])}", class_="file") for name in names
    ]
    return joined(*lines)
