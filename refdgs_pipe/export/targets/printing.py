"""For 3D printers: one closed body in millimetres, as 3MF."""

import locale
import re
import uuid
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.errors import ExportError, MeshError
from refdgs_pipe.export.targets.order import Made, Order
from refdgs_pipe.export.validate import require

F64 = NDArray[np.float64]
Faces = NDArray[np.int32]
_TIMEOUT_S = 1800.0
_CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
_UUID = re.compile(rb'UUID="[0-9a-fA-F-]{36}"')
_WRAP_PERCENT, _OFFSET_PERCENT = 0.7, 0.05  # of the diagonal


@dataclass(frozen=True)
class Body:
    """A closed surface.

    Args:
        vertices: (V, 3); faces: (F, 3), counter-clockwise outside.
        how: what closed it.
    """

    vertices: F64
    faces: Faces
    how: str


def print_(order: Order, folder: Path) -> Made:
    """asset.3mf, or asset.stl where the mesh library writes no 3MF: z up, on the plate.

    Raises:
        MeshError: the surface cannot be closed.
        ExportError: the file did not pass its check.
    """
    product = order.product
    # +Y up becomes z up, as printers have it; metres become millimetres.
    turned = product.vertices.astype(np.float64)[:, [0, 2, 1]] * [1000, -1000, 1000]
    name = call_in_child(
        "refdgs_pipe.export.targets.printing:write_body",
        {"folder": folder, "vertices": turned, "faces": product.faces},
        timeout_s=_TIMEOUT_S,
    )
    path, body = folder / name["file"], name["body"]
    if path.suffix == ".3mf":
        _steady(path)
        require(path, three_mf_faults(path))
    sides = np.ptp(body.vertices, axis=0)
    volume = _volume(body.vertices, body.faces)
    figures: dict[str, float | int | str] = {
        "triangles": len(body.faces),
        "width_mm": round(float(sides[0]), 2),
        "depth_mm": round(float(sides[1]), 2),
        "height_mm": round(float(sides[2]), 2),
        "volume_cm3": round(volume / 1000, 3),
        "closed_by": body.how,
    }
    said = " x ".join(f"{side:.4g}" for side in sides)
    notes = [f"{path.name}: {body.how}"]
    warnings = []
    if not order.is_size_known:
        notes.append(f"its size is {order.size}")
        warnings.append(
            f"target print: the real size is unknown; {path.name} is {said} mm as assumed. "
            "Give --size METRES"
        )
    summary = f"closed, {len(body.faces)} triangles, {said} mm (width x depth x height)"
    return Made(summary, figures, tuple(notes), tuple(warnings))


def write_body(folder: Path, vertices: F64, faces: Faces) -> dict[str, object]:
    """Close a surface and write it. Runs in a child process: the library may crash.

    Raises:
        MeshError: the surface cannot be closed.
    """
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    body = closed_body(meshes, vertices, faces)
    spoken = locale.setlocale(locale.LC_ALL)
    for suffix in ("3mf", "stl"):
        path = folder / f"asset.{suffix}"
        try:
            meshes.save_current_mesh(str(path))
        except pymeshlab.PyMeshLabException:
            path.unlink(missing_ok=True)
            continue
        finally:  # writing 3MF leaves the locale "C"
            locale.setlocale(locale.LC_ALL, spoken)
        return {"file": path.name, "body": body}
    raise MeshError("the mesh library writes neither 3MF nor STL: install pymeshlab again")


def closed_body(meshes: object, vertices: F64, faces: Faces) -> Body:
    """The surface closed at its holes; where it is not manifold then, wrapped (alpha wrapping).

    Alpha wrapping: Portaneri et al. 2022, as CGAL has it.

    Args:
        meshes: an empty pymeshlab.MeshSet; its current mesh is the body afterwards.

    Raises:
        MeshError: it is still not closed.
    """
    import pymeshlab

    assert isinstance(meshes, pymeshlab.MeshSet)
    points, same = np.unique(vertices, axis=0, return_inverse=True)  # cuts closed again
    meshes.add_mesh(pymeshlab.Mesh(points, same.reshape(-1)[faces].astype(np.int32)))
    for clean in ("duplicate_faces", "null_faces", "unreferenced_vertices"):
        meshes.apply_filter(f"meshing_remove_{clean}")
    meshes.meshing_repair_non_manifold_edges()
    meshes.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
    holes = int(meshes.get_topological_measures()["number_holes"])
    for careful in (True, False):
        meshes.meshing_close_holes(maxholesize=len(points), selfintersection=careful)
    meshes.meshing_repair_non_manifold_vertices(vertdispratio=0.0)  # caps can touch
    how = "it was closed already" if not holes else f"{holes} holes closed by flat caps"
    if fault_of(*_current(meshes)):
        meshes.meshing_re_orient_faces_coherently()
    if fault_of(*_current(meshes)):
        meshes.generate_alpha_wrap(
            alpha=pymeshlab.PercentageValue(_WRAP_PERCENT),
            offset=pymeshlab.PercentageValue(_OFFSET_PERCENT),
        )
        how = f"wrapped, because its surface is not manifold; details below {_WRAP_PERCENT} % of "
        how += "the diagonal are lost"
    if _volume(*_current(meshes)) < 0:
        meshes.meshing_invert_face_orientation(forceflip=True)
    _stand(meshes)
    body = Body(*_current(meshes), how)
    if fault := fault_of(body.vertices, body.faces):
        raise MeshError(f"the surface cannot be closed for printing: {fault}")
    return body


def _stand(meshes: object) -> None:
    """Put the current mesh on z = 0, in the middle of the plate."""
    points, faces = _current(meshes)
    middle = (points.min(0) + points.max(0)) / 2
    middle[2] = points[:, 2].min()
    import pymeshlab

    assert isinstance(meshes, pymeshlab.MeshSet)
    meshes.add_mesh(pymeshlab.Mesh(points - middle, faces), "object")


def _current(meshes: object) -> tuple[F64, Faces]:
    mesh = meshes.current_mesh()  # type: ignore[attr-defined]
    return np.asarray(mesh.vertex_matrix()), np.asarray(mesh.face_matrix(), np.int32)


def fault_of(vertices: F64, faces: Faces) -> str | None:
    """Why a surface is no closed manifold, consistently oriented; None if it is one."""
    if not len(faces):
        return "no triangle is left"
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2).astype(np.int64)
    keys = edges[:, 0] * len(vertices) + edges[:, 1]
    back = edges[:, 1] * len(vertices) + edges[:, 0]
    if len(np.unique(keys)) < len(keys):
        return "an edge has more than two triangles, or two that face opposite ways"
    if open_edges := int((~np.isin(keys, back)).sum()):
        return f"{open_edges} edges have one triangle only"
    return None


def _volume(vertices: F64, faces: Faces) -> float:
    """Signed volume, in the cube of the vertices' unit."""
    a, b, c = (vertices[faces[:, i]] - vertices.mean(0) for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def _steady(path: Path) -> None:
    """Give a 3MF identifiers and dates that depend on its content alone."""
    with zipfile.ZipFile(path) as package:
        parts = {name: package.read(name) for name in package.namelist()}
    count = iter(range(1 << 20))

    def identifier(_: re.Match[bytes]) -> bytes:
        return f'UUID="{uuid.uuid5(uuid.NAMESPACE_OID, f"refdgs-pipe {next(count)}")}"'.encode()

    with zipfile.ZipFile(path, "w") as package:
        for name in sorted(parts):
            content = _UUID.sub(identifier, parts[name])
            package.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)


def three_mf_faults(path: Path) -> list[str]:
    """What is wrong with a 3MF of ours: unit, parts, and whether its body is closed."""
    try:
        vertices, faces, unit = read_three_mf(path)
    except ExportError as error:
        return [str(error)]
    faults = [] if unit == "millimeter" else [f"its unit is {unit}, not millimeter"]
    if fault := fault_of(vertices, faces):
        faults.append(fault)
    elif _volume(vertices, faces) <= 0:
        faults.append("its inside is outside")
    return faults


def read_three_mf(path: Path) -> tuple[F64, Faces, str]:
    """(V, 3) vertices, (F, 3) faces and the unit of a 3MF of ours that holds one mesh.

    Raises:
        ExportError: it is not built like one.
    """
    try:
        with zipfile.ZipFile(path) as package:
            root = ElementTree.fromstring(package.read("3D/3dmodel.model"))
        rows = [[float(v.attrib[k]) for k in "xyz"] for v in root.iter(f"{_CORE}vertex")]
        corners = [
            [int(t.attrib[f"v{i}"]) for i in (1, 2, 3)] for t in root.iter(f"{_CORE}triangle")
        ]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, ElementTree.ParseError) as error:
        raise ExportError(f"{path.name}: not a 3MF: {error}") from error
    faces = np.array(corners, np.int32).reshape(-1, 3)
    return np.array(rows, np.float64).reshape(-1, 3), faces, root.attrib.get("unit", "")
