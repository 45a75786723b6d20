"""PLY files: named columns per vertex, triangles, comments. Bytes <-> arrays, no meaning."""

import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import CorruptError, ShapeError
from refdgs_pipe.trouble import raise_if_machine

# fmt: off
_DTYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}
# fmt: on
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int"} | {
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_MAX_HEADER = 1 << 16
_MAX_LIST = 255
_LEAST = 3  # corners of a face


@dataclass(frozen=True)
class Ply:
    """What a PLY file holds.

    Args:
        columns: vertex property name -> (V,) values.
        faces: (F, 3) int32, polygons fanned into triangles; None without a face element.
        comments: the header's comment lines.
    """

    columns: dict[str, NDArray[Any]]
    faces: NDArray[np.int32] | None
    comments: tuple[str, ...]


@dataclass(frozen=True)
class MeshData:
    """A triangle mesh as stored: (V, 3) vertices, (F, 3) faces, (V, 3) normals, (V, 2) uv."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None
    uv: NDArray[np.float32] | None


@dataclass(frozen=True)
class _Rows:
    """Lists of different lengths: row i has lengths[i] numbers of `dtype` from starts[i] on."""

    data: bytes
    starts: NDArray[np.int64]
    lengths: NDArray[np.int16]
    dtype: np.dtype[Any]

    def fans(self) -> NDArray[np.int32]:
        """(F, 3) the triangles of all rows, in their order."""
        ends = np.cumsum(self.lengths.astype(np.int64) - 2)
        out = np.empty((int(ends[-1]) if len(ends) else 0, 3), np.int32)
        raw = np.frombuffer(self.data, np.uint8)
        for length in np.unique(self.lengths):
            rows = np.flatnonzero(self.lengths == length)
            places = self.starts[rows, None] + np.arange(length * self.dtype.itemsize)
            polygons = np.ascontiguousarray(raw[places]).view(self.dtype)
            targets = (ends[rows] - (length - 2))[:, None] + np.arange(length - 2)
            out[targets] = _fans(polygons)
        return out


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None  # of a list's length; None for a scalar


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


def write_ply(
    path: Path,
    columns: Mapping[str, NDArray[Any]],
    faces: NDArray[np.integer[Any]] | None = None,
    *,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY.

    Args:
        columns: vertex property name -> (V,) values, in file order.
        faces: (F, 3) vertex indices.

    Raises:
        ShapeError: columns of different lengths.
    """
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1:
        raise ShapeError(f"{path.name}: columns have {sorted(lengths)} rows: give one length")
    count = lengths.pop()
    table = np.empty(count, [(n, "<" + v.dtype.str[1:]) for n, v in columns.items()])
    for name, values in columns.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    header.append(f"element vertex {count}")
    header += [f"property {_NAMES[v.dtype.str[1:]]} {n}" for n, v in columns.items()]
    body = table.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("n", "u1"), ("i", "<i4", (3,))])
        triangles["n"], triangles["i"] = 3, faces
        body += triangles.tobytes()
    path.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + body)


def read_ply(path: Path) -> Ply:
    """Read a binary PLY's vertices, triangles and comments; other elements are skipped.

    Raises:
        CorruptError: not a PLY, cut short, or a layout that cannot be meant.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise_if_machine(error)
        raise CorruptError(f"{path.name}: cannot be read ({error.strerror})") from error
    elements, comments, order, offset = _parse_header(path.name, data)
    columns: dict[str, NDArray[Any]] = {}
    faces: NDArray[np.int32] | None = None
    for element in elements:
        values, offset = _read_element(path.name, data, offset, element, order)
        if element.name == "vertex":
            if any(prop.count_dtype for prop in element.properties):
                raise CorruptError(f"{path.name}: a vertex with a list cannot be meant")
            columns = values
        elif element.name == "face":
            faces = _triangles(path.name, values)
    if faces is not None:
        rows = len(next(iter(columns.values()))) if columns else 0
        if faces.size and (faces.min() < 0 or faces.max() >= rows):
            raise CorruptError(f"{path.name}: a face names a vertex outside 0..{rows - 1}")
    return Ply(columns, faces, comments)


def write_mesh(
    path: Path,
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    *,
    normals: NDArray[np.float32] | None = None,
    uv: NDArray[np.float32] | None = None,
) -> None:
    """Write a triangle mesh: vertices (V, 3), faces (F, 3), normals (V, 3), uv (V, 2) as s, t."""
    columns = {n: vertices[:, i].astype(np.float32) for i, n in enumerate("xyz")}
    if normals is not None:
        columns |= {n: normals[:, i] for i, n in enumerate(("nx", "ny", "nz"))}
    if uv is not None:
        columns |= {n: uv[:, i] for i, n in enumerate("st")}
    write_ply(path, columns, faces)


def read_mesh(path: Path) -> MeshData:
    """Read a triangle mesh.

    Raises:
        CorruptError: broken file, no faces, or positions that are not finite.
    """
    ply = read_ply(path)
    vertices = _stack(ply, "xyz")
    if vertices is None or ply.faces is None:
        raise CorruptError(f"{path.name}: holds no triangle mesh (needs x, y, z and faces)")
    if not np.isfinite(vertices).all():
        raise CorruptError(f"{path.name}: holds vertices that are not finite")
    return MeshData(vertices, ply.faces, _stack(ply, ("nx", "ny", "nz")), _stack(ply, "st"))


def _stack(ply: Ply, names: Sequence[str]) -> NDArray[np.float32] | None:
    if any(name not in ply.columns for name in names):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([ply.columns[name] for name in names], -1).astype(np.float32)


def _parse_header(name: str, data: bytes) -> tuple[list[_Element], tuple[str, ...], str, int]:
    end = re.search(rb"\nend_header\r?\n", data[:_MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise CorruptError(f"{name}: not a PLY file")
    elements: list[_Element] = []
    comments: list[str] = []
    order = ""
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, "1.0"]:
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(kind, "")
            case ["comment", *_]:
                comments.append(line[len("comment") :].strip())
            case ["element", element, count] if count.isdigit() and len(count) < 16:
                elements.append(_Element(element, int(count), []))
            case ["property", "list", n, kind, prop] if elements and _counts(n) and _known(kind):
                elements[-1].properties.append(_Property(prop, _DTYPES[kind], _DTYPES[n]))
            case ["property", kind, prop] if elements and _known(kind):
                elements[-1].properties.append(_Property(prop, _DTYPES[kind], None))
            case [] | ["obj_info", *_]:
                pass
            case _:
                raise CorruptError(f"{name}: header line {line[:60]!r} is not understood")
    if not order:
        raise CorruptError(f"{name}: not a binary PLY 1.0: save it as binary")
    return elements, tuple(comments), order, end.end()


def _known(*kinds: str) -> bool:
    return all(kind in _DTYPES for kind in kinds)


def _counts(kind: str) -> bool:
    """Whether a type can say how long a list is."""
    return _DTYPES.get(kind, "f")[0] != "f"


def _read_element(
    name: str, data: bytes, offset: int, element: _Element, order: str
) -> tuple[dict[str, Any], int]:
    """One element's columns; a list column is (N, k) when its rows agree, else a list of rows."""
    if not element.count or not element.properties:
        return {prop.name: np.empty(0, prop.dtype) for prop in element.properties}, offset
    layout, position = [], offset
    for index, prop in enumerate(element.properties):
        if prop.count_dtype is None:
            layout.append((f"v{index}", order + prop.dtype, (1,)))
        else:
            length = _first_length(name, data, position, order + prop.count_dtype)
            layout.append((f"n{index}", order + prop.count_dtype, (1,)))
            layout.append((f"v{index}", order + prop.dtype, (length,)))
        position = offset + np.dtype(layout).itemsize
    dtype = np.dtype(layout)
    fits = offset + dtype.itemsize * element.count <= len(data)
    lists = [i for i, prop in enumerate(element.properties) if prop.count_dtype]
    if fits:
        table = np.frombuffer(data, dtype, element.count, offset)
        if all((table[f"n{i}"] == dtype[f"v{i}"].shape[0]).all() for i in lists):
            values: dict[str, Any] = {}
            for i, prop in enumerate(element.properties):
                column = table[f"v{i}"]
                values[prop.name] = column if i in lists else column[:, 0]
            return values, offset + dtype.itemsize * element.count
    if lists == [0] and len(element.properties) == 1:
        return _read_ragged(name, data, offset, element, order)
    raise CorruptError(f"{name}: cut short or irregular in element {element.name!r}")


def _first_length(name: str, data: bytes, position: int, dtype: str) -> int:
    if position + np.dtype(dtype).itemsize > len(data):
        raise CorruptError(f"{name}: cut short")
    length = int(np.frombuffer(data, dtype, 1, position)[0])
    if not 0 <= length <= _MAX_LIST:
        raise CorruptError(f"{name}: a list of {length} entries cannot be meant")
    return length


def _read_ragged(
    name: str, data: bytes, offset: int, element: _Element, order: str
) -> tuple[dict[str, Any], int]:
    """Rows of different lengths: their starts and lengths, and the bytes that they lie in."""
    prop = element.properties[0]
    count_dtype, dtype = np.dtype(order + str(prop.count_dtype)), np.dtype(order + prop.dtype)
    head, size = count_dtype.itemsize, dtype.itemsize
    if count_dtype.kind == "f" or element.count * (head + _LEAST * size) > len(data) - offset:
        raise CorruptError(f"{name}: cut short or irregular in element {element.name!r}")
    swap: Literal["little", "big"] = "little" if order == "<" else "big"
    starts, lengths = array("q"), array("h")
    for _ in range(element.count):
        length = int.from_bytes(data[offset : offset + head], swap)
        offset += head
        if not _LEAST <= length <= _MAX_LIST:
            raise CorruptError(f"{name}: a face of {length} corners cannot be meant")
        starts.append(offset)
        lengths.append(length)
        offset += length * size
    if offset > len(data):
        raise CorruptError(f"{name}: cut short in element {element.name!r}")
    return {prop.name: _Rows(data, np.array(starts), np.array(lengths), dtype)}, offset


def _triangles(name: str, values: dict[str, Any]) -> NDArray[np.int32]:
    polygons = values.get("vertex_indices", values.get("vertex_index"))
    if polygons is None:
        raise CorruptError(f"{name}: its faces have no vertex_indices")
    kind = polygons.dtype.kind
    if kind not in "iu":
        raise CorruptError(f"{name}: vertex_indices of its faces are no whole numbers")
    if isinstance(polygons, _Rows):
        return polygons.fans()
    if not len(polygons) or polygons.ndim != 2 or polygons.shape[1] < 3:
        return np.empty((0, 3), np.int32)
    return _fans(polygons).reshape(-1, 3)


def _fans(polygons: NDArray[Any]) -> NDArray[np.int32]:
    """(N, k - 2, 3) triangles of polygons (N, k)."""
    first = np.broadcast_to(polygons[:, :1], (len(polygons), polygons.shape[1] - 2))
    return np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], -1).astype(np.int32)
