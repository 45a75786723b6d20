"""Mutated files end in an error of ours: the kept ones, some new ones, and by hand many more."""

import struct
import zlib
from pathlib import Path

import fuzz
import numpy as np
import pytest
from PIL.PngImagePlugin import PngImageFile

from refdgs_pipe import recipe
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.documents import parse_json, parse_toml
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.files.colmap import read_model
from refdgs_pipe.files.images import read_photo


@pytest.mark.parametrize("name", sorted(fuzz.READERS))
def test_what_once_broke_a_reader_does_no_more(name: str, tmp_path: Path) -> None:
    assert fuzz.replay(name, tmp_path) == {}


@pytest.mark.parametrize("name", sorted(fuzz.READERS))
def test_mutated_files_end_in_an_error_of_ours(name: str) -> None:
    assert fuzz.run(name, seconds=60, seed=7, most=60) == {"inputs": 60}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", sorted(fuzz.READERS))
def test_many_mutated_files_end_in_an_error_of_ours(name: str) -> None:
    found = fuzz.run(name, seconds=60, seed=8)
    assert found == {"inputs": found["inputs"]}


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 30_000 + " = 1",
        "[" + "a." * 20_000 + "a]",
        "x = " + "[" * 20_000,
        "x = " + "{a = " * 5_000,
        "\n".join(f"[{'a.' * 65}b{i}]" for i in range(1000)),
        "x = 1\n" * 100_000,
    ],
)
def test_no_toml_takes_long(text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"long|brackets|nested|characters|dots"):
        parse_toml(text)
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(InputError):
        recipe.load(str(path))


def test_json_that_is_nested_too_deep_is_refused() -> None:
    with pytest.raises(ValueError, match="nested too deep"):
        parse_json("[" * 200_000)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("count", [2**20, 2**32, 2**63, 2**64 - 1])
def test_counts_of_a_model_are_held_against_the_file(tmp_path: Path, name: str, count: int) -> None:
    fuzz.READERS["colmap-binary"].seeds(tmp_path)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(struct.pack("<Q", count) + data[8:])
    with pytest.raises(CorruptError, match="ends early"):
        read_model(tmp_path)


def ply(count: int, body: bytes) -> bytes:
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
        "property float y\nproperty float z\n"
        f"element face {count}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + np.eye(3, dtype="<f4").tobytes() + body


def test_a_ply_of_many_empty_faces_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(3_000_000, b"\x03" + b"\0" * 12 + b"\0" * 3_000_000))
    with pytest.raises(CorruptError, match="cut short or irregular"):
        Mesh.adopt(path)


def test_faces_of_mixed_sizes_keep_their_order(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    faces = [(0, 1, 2), (2, 1, 0, 2), (1, 0, 2), (0, 1, 2, 0, 1)]
    path.write_bytes(ply(4, b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)))
    fans = [(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)]
    assert [tuple(face) for face in Mesh.adopt(path).faces.tolist()] == fans


def bomb(width: int, height: int) -> bytes:
    """A PNG of black pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    packer, body = zlib.compressobj(1), b""
    for _ in range(height):
        body += packer.compress(bytes(3 * width + 1))
    body += packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def test_a_picture_that_packs_as_no_photo_does_is_refused_undecoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(image: PngImageFile) -> None:
        raise AssertionError("it was decoded")

    path = tmp_path / "a.png"
    path.write_bytes(bomb(10_000, 6_000))
    monkeypatch.setattr(PngImageFile, "load", refuse)
    with pytest.raises(CaptureError, match="cannot be a photo of this size"):
        read_photo(path)
