"""PLY files survive the round trip, and broken ones are refused in words."""

from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.errors import CorruptError, ShapeError
from refdgs_pipe.files.ply import read_mesh, read_ply, write_mesh, write_ply

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3]], np.int32)


def test_a_mesh_survives_the_round_trip(tmp_path: Path) -> None:
    uv = VERTICES[:, :2]
    write_mesh(tmp_path / "m.ply", VERTICES, FACES, normals=VERTICES, uv=uv)
    mesh = read_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.normals, VERTICES)
    np.testing.assert_array_equal(mesh.uv, uv)


def test_columns_keep_their_types_order_and_comments(tmp_path: Path) -> None:
    columns = {"x": np.arange(5, dtype=np.float32), "kind": np.arange(5, dtype=np.uint8)}
    write_ply(tmp_path / "p.ply", columns, comments=["SplatRenderMode: 2dgs"])
    ply = read_ply(tmp_path / "p.ply")
    assert list(ply.columns) == ["x", "kind"]
    assert ply.columns["kind"].dtype == np.uint8
    assert ply.comments == ("SplatRenderMode: 2dgs",) and ply.faces is None


def test_polygons_are_fanned_into_triangles(tmp_path: Path) -> None:
    header = (
        b"ply\nformat binary_big_endian 1.0\nelement vertex 4\nproperty double x\n"
        b"property double y\nproperty double z\nelement face 2\n"
        b"property list uchar int vertex_index\nend_header\n"
    )
    body = VERTICES.astype(">f8").tobytes()
    body += b"\x04" + np.array([0, 1, 2, 3], ">i4").tobytes()
    body += b"\x03" + np.array([1, 2, 3], ">i4").tobytes()
    (tmp_path / "q.ply").write_bytes(header + body)
    mesh = read_mesh(tmp_path / "q.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 3]]
    np.testing.assert_array_equal(mesh.vertices, VERTICES)


def test_an_empty_mesh_survives_the_round_trip(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", VERTICES[:0], FACES[:0])
    assert read_mesh(tmp_path / "m.ply").faces.shape == (0, 3)


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", VERTICES, FACES)
    data = (tmp_path / "m.ply").read_bytes()
    for length in range(len(data)):
        (tmp_path / "cut.ply").write_bytes(data[:length])
        with pytest.raises(CorruptError):
            read_mesh(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"pyl\n", "not a PLY"),
        (b"binary_little_endian", b"ascii", "save it as binary"),
        (b"float x", b"floot x", "not understood"),
        (b"vertex 4", b"vertex 9999999999", "cut short"),
        (b"float z", b"float w", "no triangle mesh"),
        (b"vertex_indices", b"vertex_handles", "vertex_indices"),
    ],
)
def test_a_broken_header_is_refused_with_its_reason(
    tmp_path: Path, old: bytes, new: bytes, message: str
) -> None:
    write_mesh(tmp_path / "m.ply", VERTICES, FACES)
    data = (tmp_path / "m.ply").read_bytes()
    (tmp_path / "m.ply").write_bytes(data.replace(old, new, 1))
    with pytest.raises(CorruptError, match=message):
        read_mesh(tmp_path / "m.ply")


def test_indices_out_of_range_and_nan_are_refused(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", VERTICES, FACES + 1)
    with pytest.raises(CorruptError, match=r"outside 0\.\.3"):
        read_mesh(tmp_path / "m.ply")
    write_mesh(tmp_path / "m.ply", VERTICES * np.float32(np.nan), FACES)
    with pytest.raises(CorruptError, match="not finite"):
        read_mesh(tmp_path / "m.ply")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CorruptError, match=r"gone\.ply: cannot be read"):
        read_mesh(tmp_path / "gone.ply")


def test_columns_must_have_one_length(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match=r"\[2, 3\]"):
        write_ply(tmp_path / "p.ply", {"x": np.zeros(2), "y": np.zeros(3)})


def test_random_damage_never_escapes_as_another_error(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.ply", VERTICES, FACES)
    data = np.frombuffer((tmp_path / "m.ply").read_bytes(), np.uint8)
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(500):
        broken = data.copy()
        broken[random.integers(0, len(data), 4)] = random.integers(0, 256, 4)
        (tmp_path / "b.ply").write_bytes(broken.tobytes())
        try:
            read_mesh(tmp_path / "b.ply")
        except CorruptError:
            refused += 1
    assert refused > 100
