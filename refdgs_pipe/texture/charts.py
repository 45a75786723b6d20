"""Cutting a surface into flat charts packed in one square atlas."""

import ctypes
import importlib.util
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh, UvMesh
from refdgs_pipe.child import ChildCrashed, ChildTimeout, call_in_child
from refdgs_pipe.errors import MeshError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# An atlas is refused when more than this share of its texels is covered twice, when its areas are
# distorted more than this (Sander's L2 stretch, 1 is perfect), or when charts are torn apart.
_MAX_OVERLAP = 0.002
_MAX_STRETCH = 1.5
_CHECK_SIZE = 1024
# On a surface full of holes and handles UVAtlas takes ten times longer as a whole than in parts
# (20k faces, 520 of them: 76 s and 7 s) and gives hardly fewer charts.
_MANY_HOLES = 60
_PARTS = 4


@dataclass(frozen=True)
class Layout:
    """The figures of an atlas.

    Args:
        method: which program made it.
        charts: connected pieces in the atlas.
        used: share of the square that charts cover.
        overlap: share of the covered texels that two faces cover.
        stretch: L2 stretch (Sander et al. 2001): 1 when every face keeps its area and angles.
        mirrored: share of the covered area that is mirrored.
    """

    method: str
    charts: int
    used: float
    overlap: float
    stretch: float
    mirrored: float


@dataclass(frozen=True)
class Unwrapped:
    """A mesh with charts, the figures of its atlas, and what was tried before it and why not."""

    mesh: UvMesh
    layout: Layout
    refused: tuple[str, ...]


def unwrap(
    mesh: Mesh,
    *,
    gutter: float,
    max_stretch: float,
    timeout_s: float,
    stop: threading.Event | None = None,
) -> Unwrapped:
    """Unwrap with the best program that gives a sound atlas in time.

    Args:
        gutter: space between charts, as a share of the atlas's side.
        max_stretch: how much UVAtlas may stretch a chart before it cuts, 0 to 1.
        timeout_s: for each program.

    Raises:
        MeshError: the mesh has no faces, or vertices that no program could place.
        Cancelled: `stop` was set.
    """
    if not len(mesh.faces):
        raise MeshError("the mesh has no faces to unwrap: look at the cleaned mesh (clean)")
    lost = np.flatnonzero(~np.isfinite(mesh.vertices).all(1))
    if len(lost):
        raise MeshError(
            f"{len(lost)} vertices of the mesh are not finite, the first is number {lost[0]}: "
            "expected coordinates in world units. Repair the adopted mesh, or drop it"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise MeshError(
            f"a face of the mesh names vertex {mesh.faces.max()} of {len(mesh.vertices)}: "
            "repair the adopted mesh, or drop it"
        )
    shape = {"vertices": mesh.vertices, "faces": mesh.faces, "gutter": gutter}
    uvatlas = {**shape, "max_stretch": max_stretch}
    attempts = [
        ("UVAtlas", "uvatlas_corners", uvatlas | {"partitions": 1}),
        ("UVAtlas in parts", "uvatlas_corners", uvatlas | {"partitions": _PARTS}),
        ("xatlas", "xatlas_corners", shape),
    ]
    if holes_and_handles(mesh) > _MANY_HOLES:
        attempts.pop(0)
    refused: list[str] = []
    for method, function, arguments in attempts:
        try:
            corners = call_in_child(
                f"refdgs_pipe.texture.charts:{function}", arguments, timeout_s=timeout_s, stop=stop
            )
        except (ChildCrashed, ChildTimeout, RuntimeError) as error:
            refused.append(f"{method}: {str(error).splitlines()[0]}")
            continue
        corners = unmirrored(corners)
        layout = measure(method, mesh, corners)
        fault = _fault(corners, layout)
        if fault is None:
            return Unwrapped(seam_split(mesh, corners), layout, tuple(refused))
        refused.append(f"{method}: {fault}")
    corners = unmirrored(one_by_one_corners(len(mesh.faces)))
    layout = measure("face by face", mesh, corners)
    return Unwrapped(seam_split(mesh, corners), layout, tuple(refused))


def holes_and_handles(mesh: TriangleMesh) -> int:
    """How many holes and handles a mesh has, pieces beyond the first taken off (Euler)."""
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    count = len(np.unique(np.sort(edges, axis=1), axis=0))
    return 2 - (len(np.unique(mesh.faces)) - count + len(mesh.faces))


def uvatlas_corners(
    vertices: F32, faces: NDArray[np.int32], gutter: float, max_stretch: float, partitions: int
) -> F32:
    """(F, 3, 2) texture coordinates of every face's corners by Microsoft's UVAtlas.

    Runs in a child process: it crashes on meshes that are not manifold.
    """
    _use_same_seeds()
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.from_numpy(vertices),
        o3d.core.Tensor.from_numpy(faces.astype(np.int64)),  # parts need 64-bit indices
    )
    mesh.compute_uvatlas(
        size=_CHECK_SIZE,
        gutter=gutter * _CHECK_SIZE,
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


def xatlas_corners(vertices: F32, faces: NDArray[np.int32], gutter: float) -> F32:
    """(F, 3, 2) texture coordinates of every face's corners by xatlas."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution = _CHECK_SIZE
    packing.padding = max(1, round(gutter * _CHECK_SIZE))
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


def unmirrored(corners: F32) -> F32:
    """The atlas turned over if most of it is mirrored.

    v grows downwards, so a face that is counter-clockwise outside must have negative area here.
    """
    if _signed_areas(corners).sum() > 0:
        corners = np.stack([corners[..., 0], 1 - corners[..., 1]], -1)
    return np.clip(corners, 0, 1)


def seam_split(mesh: TriangleMesh, corners: F32) -> UvMesh:
    """The mesh with its vertices repeated along seams. Normals are taken before the cut."""
    vertex = mesh.faces.reshape(-1)
    keys = np.concatenate(
        [vertex[:, None].astype(np.int64), corners.reshape(-1, 2).view(np.int32)], axis=1
    )
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    source = vertex[first]
    return UvMesh(
        mesh.vertices[source],
        mesh.vertex_normals()[source],
        corners.reshape(-1, 2)[first],
        faces.reshape(-1, 3).astype(np.int32),
    )


def measure(method: str, mesh: TriangleMesh, corners: F32) -> Layout:
    """The figures of an atlas given by its corners (F, 3, 2)."""
    from refdgs_pipe.texture.texels import coverage

    signed = _signed_areas(corners)
    covered = coverage(corners, _CHECK_SIZE)
    split = seam_split(mesh, corners)
    return Layout(
        method,
        charts=_chart_count(split),
        used=float((covered > 0).mean()),
        overlap=float((covered > 1).sum() / max(1, (covered > 0).sum())),
        stretch=_stretch(mesh, corners),
        mirrored=float(signed[signed > 0].sum() / max(1e-12, np.abs(signed).sum())),
    )


def _fault(corners: F32, layout: Layout) -> str | None:
    """Why an atlas cannot be used; None for a good one."""
    if not np.isfinite(corners).all():
        return "texture coordinates that are not finite"
    faults: list[tuple[bool, Callable[[], str]]] = [
        (layout.overlap > _MAX_OVERLAP, lambda: f"{layout.overlap:.2%} of the texels overlap"),
        (layout.stretch > _MAX_STRETCH, lambda: f"stretch {layout.stretch:.2f}"),
    ]
    return next((text() for is_bad, text in faults if is_bad), None)


def _signed_areas(corners: F32) -> F64:
    a, b, c = (corners[:, i].astype(np.float64) for i in range(3))
    u, v = b - a, c - a
    return np.asarray((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)


def _stretch(mesh: TriangleMesh, corners: F32) -> float:
    """L2 stretch of the map from the atlas to the surface, scaled so that 1 is the best."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    s, t, w = (corners[:, i].astype(np.float64) for i in range(3))
    area3 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    area2 = _signed_areas(corners)
    sound = np.abs(area2) > 1e-14
    twice = np.where(sound, 2 * area2, 1)[:, None]
    along_u = (a * (t - w)[:, 1:] + b * (w - s)[:, 1:] + c * (s - t)[:, 1:]) / twice
    along_v = (a * (w - t)[:, :1] + b * (s - w)[:, :1] + c * (t - s)[:, :1]) / twice
    mean_square = ((along_u**2).sum(1) + (along_v**2).sum(1)) / 2
    total = float((mean_square * area3)[sound].sum() / max(area3[sound].sum(), 1e-30))
    return float(np.sqrt(total * np.abs(area2).sum() / max(area3.sum(), 1e-30)))


def _chart_count(mesh: UvMesh) -> int:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(mesh.vertices)
    start, end = mesh.faces[:, [0, 1]].reshape(-1), mesh.faces[:, [1, 2]].reshape(-1)
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(n, n))
    return int(connected_components(graph, directed=False)[0])
