"""Read the triangles of a Wavefront OBJ file."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from refdgs_pipe.errors import CorruptError
from refdgs_pipe.files.ply import MeshData
from refdgs_pipe.formatting import printable
from refdgs_pipe.trouble import raise_if_machine


def read_obj(path: Path) -> MeshData:
    """Positions and faces; polygons become fans of triangles. Normals, uv and groups are left out.

    Raises:
        CorruptError: no faces, a broken line, or a face that names a vertex that is not there.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        lines = path.read_text("utf-8", "replace").splitlines()
    except OSError as error:
        raise_if_machine(error)
        raise CorruptError(f"{path.name}: cannot be read ({error.strerror})") from None
    for number, line in enumerate(lines, start=1):
        kind, *values = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, values[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                corners = [int(value.partition("/")[0]) for value in values]
                ids = [i - 1 if i > 0 else len(vertices) + i for i in corners]
                faces += [(ids[0], b, c) for b, c in pairwise(ids[1:])]
        except (ValueError, IndexError):
            shown = printable(line[:80])
            raise CorruptError(f"{path.name}: line {number} is not understood: {shown}") from None
    with np.errstate(over="ignore"):
        positions = np.array(vertices, np.float32).reshape(-1, 3)
    try:
        triangles = np.array(faces, np.int64).reshape(-1, 3)
    except OverflowError:
        raise CorruptError(f"{path.name}: a face names a vertex that is not there") from None
    if not len(triangles) or not np.isfinite(positions).all():
        raise CorruptError(f"{path.name}: holds no faces, or vertices that are not finite")
    if triangles.min() < 0 or triangles.max() >= len(positions):
        raise CorruptError(f"{path.name}: a face names a vertex that is not there")
    return MeshData(positions, triangles.astype(np.int32), None, None)
