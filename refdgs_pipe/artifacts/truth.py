"""Where a data set keeps the ground truth beside its photos. Paths only: nothing is opened.

Known layouts, of which any part may be missing:

* our scenes: r_0_normal.png, r_0_depth.npz, r_0_albedo.png beside r_0.png; gt_mesh.ply and
  materials.json in the data set's folder;
* Shiny Blender: r_0_normal.png, r_0_alpha.png;
* Glossy Synthetic (NeRO): 0-depth.png beside 0.png or in ../depth; eval_pts.ply;
* photos without poses: gt_mesh.ply and cameras_gt.json in the folder, or beside `images`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TruthFiles:
    """The ground truth of one photo; None for what is not there."""

    photo: Path
    normal: Path | None
    depth: Path | None
    alpha: Path | None
    albedo: Path | None


@dataclass(frozen=True)
class SceneTruthFiles:
    """The ground truth of a whole data set; None for what is not there."""

    mesh: Path | None
    points: Path | None
    materials: Path | None
    cameras: Path | None


def view_truth_files(photo: Path) -> TruthFiles:
    """What lies beside a photo, by name."""
    stem, beside = photo.stem, photo.parent
    depths = (
        beside / f"{stem}_depth.npz",
        beside / f"{stem}-depth.png",
        beside.parent / "depth" / f"{stem}-depth.png",
    )
    return TruthFiles(
        photo,
        normal=_first(beside / f"{stem}_normal.png"),
        depth=_first(*depths),
        alpha=_first(beside / f"{stem}_alpha.png"),
        albedo=_first(beside / f"{stem}_albedo.png"),
    )


def scene_truth_files(root: Path) -> SceneTruthFiles:
    """What lies in the folder of a data set, or beside it where that is `images`."""
    names = ("gt_mesh.ply", "eval_pts.ply", "materials.json", "cameras_gt.json")
    folders = (root, root.parent) if root.name == "images" else (root,)
    found = (_first(*(folder / name for folder in folders)) for name in names)
    return SceneTruthFiles(*found)


def all_truth_files(root: Path, photos: Iterable[Path]) -> set[Path]:
    """Every file of ground truth that belongs to a data set with these photos."""
    scene = scene_truth_files(root)
    found = {scene.mesh, scene.points, scene.materials, scene.cameras}
    for photo in photos:
        files = view_truth_files(photo)
        found |= {files.normal, files.depth, files.alpha, files.albedo}
    return {path for path in found if path is not None}


def photo_truth_files(root: Path) -> set[Path]:
    """The true surface and cameras of photos without poses; nothing unless both are there."""
    scene = scene_truth_files(root)
    if scene.mesh is None or scene.cameras is None:
        return set()
    return {scene.mesh, scene.cameras}


def _first(*candidates: Path) -> Path | None:
    return next((path for path in candidates if path.is_file()), None)
