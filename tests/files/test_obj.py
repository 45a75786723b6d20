"""Laws of reading OBJ files."""

from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.files.obj import read_obj

SQUARE = "# a square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n"


def write(folder: Path, faces: str) -> Path:
    path = folder / "mesh.obj"
    path.write_text(SQUARE + faces)
    return path


def test_polygons_become_fans_and_indices_may_count_from_the_end(tmp_path: Path) -> None:
    for faces in ("f 1/1/1 2//1 3 4\n", "f -4 -3 -2 -1\n"):
        data = read_obj(write(tmp_path, faces))
        assert np.array_equal(data.faces, [[0, 1, 2], [0, 2, 3]])
        assert data.vertices.shape == (4, 3)


@pytest.mark.parametrize("faces", ["", "f 1 2 9\n", "f one two three\n", "f -9 1 2\n"])
def test_a_broken_file_is_an_error(tmp_path: Path, faces: str) -> None:
    with pytest.raises(CorruptError, match=r"mesh\.obj"):
        read_obj(write(tmp_path, faces))


def test_an_edited_mesh_is_adopted_from_obj_and_ply(tmp_path: Path) -> None:
    mesh = Mesh.adopt(write(tmp_path, "f 1 2 3\n"))
    mesh.save(tmp_path)
    assert np.array_equal(Mesh.adopt(tmp_path / "mesh.ply").faces, mesh.faces)
    with pytest.raises(InputError, match=r"\.ply or \.obj"):
        Mesh.adopt(tmp_path / "mesh.glb")
