"""Ground truth that came with a data set, decoded. Nothing in it is executed or unpickled."""

import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.truth import TruthFiles
from refdgs_pipe.color import fractions, linear_from_srgb
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.files.images import read_photo, read_png
from refdgs_pipe.files.ply import read_mesh, read_ply

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NERO_DEPTH = 15.0  # scene units at the 16-bit PNG's white
_NERO_BACKGROUND = 14.5  # from here on there is no surface


@dataclass(frozen=True)
class ViewTruth:
    """What one view should show, (H, W[, 3]); None for what did not come with it.

    Args:
        normal: float32, world space, over the vector (1, 1, 1), any length.
        foreground: where `normal` is the object's.
        depth: float32 camera z in world units; 0 where there is no surface.
        alpha: float32 coverage in [0, 1].
    """

    normal: F32 | None
    foreground: Mask | None
    depth: F32 | None
    alpha: F32 | None

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height in pixels; None if nothing came with the view."""
        maps = (self.normal, self.depth, self.alpha)
        shape = next((values.shape for values in maps if values is not None), None)
        return None if shape is None else (shape[1], shape[0])


@dataclass(frozen=True)
class TruePart:
    """A part of the object: its name, and 1 for metal, 0 for anything else.

    Parts of one `material` are told alike in all but name and number.
    """

    name: str
    metallic: float
    material: str


@dataclass(frozen=True)
class MaterialTruth:
    """The materials that one view should show, (H, W[, 3]).

    Args:
        depth: float32 camera z in world units.
        part: int64 number of the part in the list of parts; -1 where there is none.
        albedo: float32 linear: base colour, of metals the reflectance.
        roughness: float32: the square root of the GGX alpha; 1 for matte.
    """

    depth: F32
    part: NDArray[np.int64]
    albedo: F32
    roughness: F32


def read_view_truth(files: TruthFiles) -> ViewTruth:
    """The truth of one photo.

    Raises:
        CorruptError: a file is damaged, or does not hold what its name says.
        InputError: the maps of one photo differ in size.
    """
    depth = None if files.depth is None else _read_depth(files.depth)
    alpha, covers = _read_alpha(files)
    if alpha is None and depth is not None and files.depth is not None:
        alpha, covers = (depth > 0).astype(np.float32), files.depth
    normal, valid = None, None
    if files.normal is not None:
        normal, valid = _read_normal(files.normal)
    foreground = valid
    if foreground is None and normal is not None:
        foreground = np.asarray(alpha >= 0.5 if alpha is not None else (normal < 0.999).any(-1))
    found = {
        path: values.shape[:2]
        for path, values in (
            (files.normal, normal),
            (files.depth, depth),
            (covers, alpha),
        )
        if path is not None and values is not None
    }
    if len(set(found.values())) > 1:
        sizes = ", ".join(f"{p.name} {s[1]} x {s[0]}" for p, s in found.items())
        raise InputError(
            f"{files.photo}: its ground truth differs in size ({sizes} pixels). "
            "Give maps of one size"
        )
    return ViewTruth(normal, foreground, depth, alpha)


def read_true_mesh(path: Path) -> TriangleMesh:
    """The true surface: faces that cameras see; it need not be closed.

    Raises:
        CorruptError: damaged, or without triangles.
    """
    data = read_mesh(path)
    if not len(data.faces):
        raise CorruptError(f"{path}: holds no triangles; a true surface needs some")
    return TriangleMesh(data.vertices, data.faces)


def read_true_points(path: Path) -> F64:
    """(P, 3) points on the true surface.

    Raises:
        CorruptError: damaged, or without points.
    """
    columns = read_ply(path).columns
    if any(name not in columns or not len(columns[name]) for name in "xyz"):
        raise CorruptError(f"{path}: holds no points with x, y and z")
    points = np.stack([columns[name] for name in "xyz"], -1).astype(np.float64)
    if not np.isfinite(points).all():
        raise CorruptError(f"{path}: holds points that are not finite")
    return points


def read_true_parts(path: Path) -> dict[int, TruePart]:
    """The parts of the object by their ids, from materials.json.

    Raises:
        CorruptError: it is damaged.
    """
    try:
        records = json.loads(path.read_text("utf-8"))
        return {
            int(r["object_id"]): TruePart(str(r["name"]), float(r["metallic"]), _material(r))
            for r in records
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorruptError(f"{path}: expected a list of materials ({error})") from None


def _material(record: dict[str, Any]) -> str:
    """What two parts have in common if they are made of one material."""
    told = {k: v for k, v in record.items() if k not in ("object_id", "name")}
    return json.dumps(told, sort_keys=True)


def read_material_truth(files: TruthFiles, ids: list[int]) -> MaterialTruth | None:
    """The true materials of one photo; None if it came without.

    Args:
        ids: of the parts, in their order.

    Raises:
        CorruptError: a file is damaged, or the files differ in size.
    """
    if files.albedo is None or files.depth is None or files.depth.suffix != ".npz":
        return None
    depth = _read_depth(files.depth)
    with np.load(files.depth, allow_pickle=False) as data:
        if not {"object_id", "alpha_ggx"} <= set(data.files):
            return None
        numbers, alpha = data["object_id"], data["alpha_ggx"]
    albedo = fractions(read_png(files.albedo))
    if albedo.ndim != 3 or not albedo.shape[:2] == depth.shape == numbers.shape == alpha.shape:
        raise CorruptError(f"{files.albedo}: not a colour picture of {files.depth.name}'s size")
    part = np.full(depth.shape, -1, np.int64)
    for place, number in enumerate(ids):
        part[(numbers == number) & (depth > 0)] = place
    roughness = np.sqrt(alpha.astype(np.float32) / np.float32(255))
    return MaterialTruth(depth, part, linear_from_srgb(albedo[..., :3]), roughness)


def _read_normal(path: Path) -> tuple[F32, Mask | None]:
    """The vectors over (1, 1, 1), and where the file's own alpha says that they are valid."""
    pixels = fractions(read_png(path))
    if pixels.ndim != 3:
        raise CorruptError(f"{path}: {pixels.shape} pixels; expected a colour PNG of normals")
    rgb, valid = pixels[..., :3], None
    if pixels.shape[2] == 4:
        a = pixels[..., 3:]
        rgb, valid = rgb * a + (1 - a), pixels[..., 3] >= 0.5
    return (rgb * 2 - 1).astype(np.float32), valid


def _read_depth(path: Path) -> F32:
    if path.suffix == ".png":
        pixels = read_png(path)
        if pixels.ndim != 2 or pixels.dtype != np.uint16:
            raise CorruptError(f"{path}: expected a 16-bit grey PNG of depths")
        depth = fractions(pixels) * np.float32(_NERO_DEPTH)
        return np.where(depth < _NERO_BACKGROUND, depth, np.float32(0))
    try:
        with np.load(path, allow_pickle=False) as data:
            depth = data["depth"]
        if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
            raise ValueError(f"`depth` is {depth.dtype} of shape {depth.shape}")
        if not np.isfinite(depth).all():
            raise ValueError("`depth` is not finite everywhere")
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise CorruptError(f"{path}: expected an npz with `depth`, (H, W) ({error})") from None
    return np.asarray(depth, np.float32)


def _read_alpha(files: TruthFiles) -> tuple[F32 | None, Path]:
    """From a file of its own, else the photo's alpha channel; and which file that is."""
    if files.alpha is not None:
        pixels = fractions(read_png(files.alpha))
        return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., 0]), files.alpha
    try:
        photo = read_photo(files.photo, upright=False)
    except (CaptureError, OSError) as error:
        raise CorruptError(f"{files.photo}: {error}") from None
    alpha = np.ascontiguousarray(fractions(photo)[..., 3]) if photo.shape[2] == 4 else None
    return alpha, files.photo
