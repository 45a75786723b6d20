"""The programs that cut a surface into charts, each behind the same few arguments.

UVAtlas and xatlas are called in child processes (see `charts.unwrap`): they crash on some meshes.
"""

import ctypes
import importlib.util
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
_SIZE = 1024  # texels of the atlas that the programs think of


@dataclass(frozen=True)
class Program:
    """One way to make an atlas.

    Args:
        target: of a child process; it gives (F, 3, 2) texture coordinates of the faces' corners.
        options: what it takes beside vertices, faces, gutter and max_stretch.
    """

    name: str
    backend: Literal["uvatlas", "xatlas"]
    target: str
    options: dict[str, Any] = field(default_factory=dict)


# By the time that they take, and what few seams they make.
PROGRAMS = (
    Program("UVAtlas", "uvatlas", f"{__name__}:uvatlas_corners", {"partitions": 1}),
    Program("UVAtlas in parts", "uvatlas", f"{__name__}:uvatlas_corners", {"partitions": 4}),
    Program("xatlas", "xatlas", f"{__name__}:xatlas_corners"),
)


def uvatlas_corners(
    vertices: F32, faces: NDArray[np.int32], gutter: float, max_stretch: float, partitions: int
) -> F32:
    """(F, 3, 2) texture coordinates of every face's corners by Microsoft's UVAtlas.

    Args:
        gutter: space between charts, as a share of the atlas's side.
        max_stretch: how much a chart may be stretched before it is cut, 0 to 1.
        partitions: the mesh is cut into that many parts first, or more.
    """
    _use_same_seeds()
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.from_numpy(vertices),
        o3d.core.Tensor.from_numpy(faces.astype(np.int64)),  # parts need 64-bit indices
    )
    mesh.compute_uvatlas(
        size=_SIZE,
        gutter=gutter * _SIZE,
        max_stretch=max_stretch,
        parallel_partitions=partitions,
        nthreads=min(partitions, 2),
    )
    return np.asarray(mesh.triangle["texture_uvs"].numpy(), np.float32)


def _use_same_seeds() -> None:
    """Let UVAtlas draw the same lots every time; must come before its library is loaded.

    Its only randomness is the seeds that it takes from std::random_device. Where our stand-in for
    that was not built (not Linux), atlases differ from run to run.
    """
    native = importlib.util.find_spec("_refdgs_native")
    if native is None or native.origin is None:
        return
    stand_in = Path(native.origin).parent / "_refdgs_same_seeds.so"
    if stand_in.is_file():
        ctypes.CDLL(str(stand_in), mode=ctypes.RTLD_GLOBAL)


def xatlas_corners(
    vertices: F32, faces: NDArray[np.int32], gutter: float, max_stretch: float
) -> F32:
    """(F, 3, 2) texture coordinates of every face's corners by xatlas.

    It weighs stretch against seams in its own way: `max_stretch` is UVAtlas's alone.
    """
    del max_stretch
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution = _SIZE
    packing.padding = max(1, round(gutter * _SIZE))
    packing.rotate_charts = False  # turning a chart mirrors it
    atlas.generate(xatlas.ChartOptions(), packing)
    _, indices, uv = atlas.get_mesh(0)
    # Each axis is scaled to its own side of the atlas; a square atlas needs one scale.
    sides = np.array([atlas.width, atlas.height], np.float32)
    return np.asarray((uv * sides / sides.max())[indices], np.float32)


def one_by_one_corners(count: int) -> F32:
    """(count, 3, 2): every face alone, two to a cell of a grid. It always works."""
    side = int(np.ceil(np.sqrt((count + 1) // 2)))
    cell = np.arange(count) // 2
    low = np.array([[0.08, 0.08], [0.08, 0.76], [0.76, 0.08]])
    shapes = np.stack([low, 1 - low])[np.arange(count) % 2]
    origin = np.stack([cell % side, cell // side], -1)[:, None]
    return np.asarray((origin + shapes) / side, np.float32)
