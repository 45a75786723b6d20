"""COLMAP models survive writing and reading, and COLMAP itself reads ours."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.errors import CorruptError
from refdgs_pipe.files.colmap import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    opencv_lens,
    read_model,
    write_model,
)


def model() -> ColmapModel:
    rng = np.random.default_rng(0)
    cameras = {
        1: ColmapCamera("PINHOLE", 640, 480, np.array([600.1, 601.2, 320.0, 240.0])),
        2: ColmapCamera("OPENCV", 320, 240, np.array([300, 301, 160, 120, 0.1, -0.2, 1e-3, 2e-3])),
    }
    images = {}
    for i in range(1, 5):
        quat = rng.normal(size=4)
        ids = np.array([0, -1, i, 5], np.int64)
        name = f"with space {i}.png"
        keypoints = rng.uniform(0, 300, (4, 2))
        quat /= np.linalg.norm(quat)
        images[i] = ColmapImage(quat, rng.normal(size=3), 1 + i % 2, name, keypoints, ids)
    ids = np.arange(6, dtype=np.int64)
    colors = rng.integers(0, 255, (6, 3), np.uint8)
    return ColmapModel(cameras, images, ids, rng.normal(size=(6, 3)), colors, np.full(6, 0.5))


@pytest.mark.parametrize("text", [False, True])
def test_a_model_comes_back_exactly(tmp_path: Path, text: bool) -> None:
    wrote = model()
    write_model(tmp_path, wrote, text=text)
    read = read_model(tmp_path)
    assert read.cameras.keys() == wrote.cameras.keys()
    for key, camera in wrote.cameras.items():
        assert (read.cameras[key].model, read.cameras[key].width) == (camera.model, camera.width)
        np.testing.assert_array_equal(read.cameras[key].params, camera.params)
    for key, image in wrote.images.items():
        assert read.images[key].name == image.name
        for field in ("quat", "translation", "keypoints", "point_ids"):
            np.testing.assert_array_equal(getattr(read.images[key], field), getattr(image, field))
    for field in ("point_ids", "xyz", "rgb", "errors"):
        np.testing.assert_array_equal(getattr(read, field), getattr(wrote, field))


def test_colmap_reads_our_models_and_we_read_its(tmp_path: Path) -> None:
    """In a process of its own: pycolmap must not be loaded beside the other tests' libraries."""
    pytest.importorskip("importlib.metadata").version("pycolmap")
    for name in ("ours", "bin", "txt"):
        (tmp_path / name).mkdir()
    write_model(tmp_path / "ours", model())
    code = (
        "import sys, cv2, pycolmap; from pathlib import Path; at = Path(sys.argv[1])\n"
        "found = pycolmap.Reconstruction(at / 'ours')\n"
        "found.write_binary(at / 'bin'); found.write_text(at / 'txt')\n"
        "print(found.num_reg_images(), found.num_points3D(), found.compute_num_observations())\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["4", "6", "12"]
    for name in ("bin", "txt"):
        read = read_model(tmp_path / name)
        for key, image in model().images.items():
            np.testing.assert_allclose(read.images[key].quat, image.quat, atol=1e-12)
            np.testing.assert_array_equal(read.images[key].point_ids, image.point_ids)
        np.testing.assert_allclose(read.xyz[np.argsort(read.point_ids)], model().xyz, atol=1e-12)


@pytest.mark.parametrize("text", [False, True])
def test_a_damaged_model_is_a_corrupt_file(tmp_path: Path, text: bool) -> None:
    with pytest.raises(CorruptError, match="missing"):
        read_model(tmp_path)
    write_model(tmp_path, model(), text=text)
    images = tmp_path / ("images.txt" if text else "images.bin")
    images.write_bytes(images.read_bytes()[:-30] + (b" x" if text else b""))
    with pytest.raises(CorruptError, match="damaged"):
        read_model(tmp_path)


def test_every_lens_model_that_opencv_knows_becomes_its_coefficients() -> None:
    K, d = opencv_lens("SIMPLE_RADIAL", np.array([500, 320, 240, 0.1]))
    np.testing.assert_array_equal(K, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    np.testing.assert_array_equal(d, [0.1, 0, 0, 0, 0, 0, 0, 0])
    K, d = opencv_lens("OPENCV", np.array([500, 501, 320, 240, 1, 2, 3, 4]))
    assert K[1, 1] == 501
    np.testing.assert_array_equal(d, [1, 2, 3, 4, 0, 0, 0, 0])
    with pytest.raises(ValueError, match="FOV"):
        opencv_lens("FOV", np.zeros(5))
