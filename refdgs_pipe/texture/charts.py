"""Cutting a surface into flat charts packed in one square atlas."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh, UvMesh
from refdgs_pipe.child_process import ChildCrashed, ChildTimeout, call_in_child
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture.programs import PROGRAMS, Program, one_by_one_corners

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Backend: TypeAlias = Literal["auto", "uvatlas", "xatlas"]

# An atlas is refused when more than this share of its texels is covered twice, when its areas are
# distorted more than this (Sander's L2 stretch, 1 is perfect), or when charts are torn apart.
_MAX_OVERLAP = 0.002
_MAX_STRETCH = 1.5
_CHECK_SIZE = 1024
# On a surface full of holes and handles UVAtlas takes ten times longer as a whole than in parts
# (20k faces, 520 of them: 76 s and 7 s) and gives hardly fewer charts.
_MANY_HOLES = 60
# An atlas of this worth ends the search: the next program would take longer than it could gain.
_GOOD = 0.4


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

    @property
    def worth(self) -> float:
        """The share of the square that an unstretched atlas of the same sharpness would fill."""
        return self.used / self.stretch**2


@dataclass(frozen=True)
class Unwrapped:
    """A mesh with charts.

    Args:
        layout: the figures of its atlas.
        tried: those of all sound atlases that were made.
        refused: which programs failed or gave no sound atlas, and why.
    """

    mesh: UvMesh
    layout: Layout
    tried: tuple[Layout, ...]
    refused: tuple[str, ...]


def unwrap(
    mesh: Mesh,
    *,
    gutter: float,
    max_stretch: float,
    timeout_s: float,
    backend: Backend = "auto",
    stop: threading.Event | None = None,
) -> Unwrapped:
    """Unwrap with the better program, or the one that is left when the other fails.

    "auto" goes from the fastest program to the slowest and stops at the first atlas that is worth
    enough; if none is, the one that is worth most is taken. Time itself is not looked at, so that
    the same mesh always gets the same atlas.

    Args:
        gutter: space between charts, as a share of the atlas's side.
        max_stretch: how much UVAtlas may stretch a chart before it cuts, 0 to 1.
        timeout_s: for each program.
        backend: a program to prefer, whatever its atlas is worth.

    Raises:
        MeshError: the mesh has no faces, or vertices that no program could place.
        Cancelled: `stop` was set.
    """
    _require_sound(mesh)
    order = sorted(PROGRAMS, key=lambda program: program.backend != backend)
    if holes_and_handles(mesh) > _MANY_HOLES:
        order.remove(PROGRAMS[0])
    best: tuple[Layout, F32] | None = None
    tried: list[Layout] = []
    refused: list[str] = []
    for program in order:
        try:
            corners = _run(program, mesh, gutter, max_stretch, timeout_s, stop)
            layout = measure(program.name, mesh, corners)
            _require_usable(corners, layout)
        except (ChildCrashed, ChildTimeout, RuntimeError, MeshError) as error:
            refused.append(f"{program.name}: {str(error).splitlines()[0]}")
            continue
        tried.append(layout)
        if best is None or layout.worth > best[0].worth:
            best = layout, corners
        if backend != "auto" or layout.worth >= _GOOD:
            break
    if best is None:
        corners = unmirrored(one_by_one_corners(len(mesh.faces)))
        best = measure("face by face", mesh, corners), corners
    return Unwrapped(seam_split(mesh, best[1]), best[0], tuple(tried), tuple(refused))


def _require_sound(mesh: Mesh) -> None:
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


def _run(
    program: Program,
    mesh: Mesh,
    gutter: float,
    max_stretch: float,
    timeout_s: float,
    stop: threading.Event | None,
) -> F32:
    """(F, 3, 2) what a program gives, in a process of its own."""
    arguments = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "gutter": gutter,
        "max_stretch": max_stretch,
        **program.options,
    }
    return unmirrored(call_in_child(program.target, arguments, timeout_s=timeout_s, stop=stop))


def holes_and_handles(mesh: TriangleMesh) -> int:
    """How many holes and handles a mesh has, pieces beyond the first taken off (Euler)."""
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    count = len(np.unique(np.sort(edges, axis=1), axis=0))
    return 2 - (len(np.unique(mesh.faces)) - count + len(mesh.faces))


def unmirrored(corners: F32) -> F32:
    """The atlas turned over if most of it is mirrored.

    v grows downwards, so a face that is counter-clockwise outside must have negative area here.
    """
    if signed_areas(corners).sum() > 0:
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

    signed = signed_areas(corners)
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


def _require_usable(corners: F32, layout: Layout) -> None:
    faults: list[tuple[bool, Callable[[], str]]] = [
        (
            not np.isfinite(corners).all(),
            lambda: "texture coordinates that are not finite",
        ),
        (layout.overlap > _MAX_OVERLAP, lambda: f"{layout.overlap:.2%} of the texels overlap"),
        (layout.stretch > _MAX_STRETCH, lambda: f"stretch {layout.stretch:.2f}"),
    ]
    for is_bad, text in faults:
        if is_bad:
            raise MeshError(text())


def signed_areas(corners: F32) -> F64:
    """(F,) areas of triangles (F, 3, 2) in the atlas; negative if they are clockwise there."""
    a, b, c = (corners[:, i].astype(np.float64) for i in range(3))
    u, v = b - a, c - a
    return np.asarray((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)


def _stretch(mesh: TriangleMesh, corners: F32) -> float:
    """L2 stretch of the map from the atlas to the surface, scaled so that 1 is the best."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    s, t, w = (corners[:, i].astype(np.float64) for i in range(3))
    area3 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    area2 = signed_areas(corners)
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
