"""Ground truth beside photos: found by name, decoded safely, refused in words."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.truth import view_truth_files
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.evaluation.materials import roughness_rank
from refdgs_pipe.evaluation.truth import (
    read_true_mesh,
    read_true_parts,
    read_true_points,
    read_view_truth,
)
from refdgs_pipe.files.ply import write_mesh, write_ply


def save(path: Path, *values: float, size: tuple[int, int] = (6, 4)) -> Path:
    """A PNG of one colour."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.broadcast_to(np.array(values, np.uint8), (*size, len(values)))
    Image.fromarray(np.squeeze(pixels)).save(path)
    return path


def scene_photo(folder: Path) -> Path:
    """A photo with everything that our scenes have."""
    photo = save(folder / "r_0.png", 10, 20, 30, 255)
    save(folder / "r_0_normal.png", 128, 128, 255, 255)
    np.savez(folder / "r_0_depth.npz", allow_pickle=False, depth=np.full((6, 4), 2, np.float32))
    return photo


def test_everything_beside_a_photo_of_our_scenes_is_read(tmp_path: Path) -> None:
    truth = read_view_truth(view_truth_files(scene_photo(tmp_path)))
    assert truth.size == (4, 6)
    assert truth.normal is not None and truth.depth is not None and truth.alpha is not None
    assert np.allclose(truth.normal, [0, 0, 1], atol=0.005)  # half a step of 8 bits
    assert truth.foreground is not None and truth.foreground.all()
    assert (truth.depth == 2).all() and (truth.alpha == 1).all()


def test_parts_of_one_material_count_as_one(tmp_path: Path) -> None:
    chrome, glaze = {"metallic": 1.0, "alpha_ggx": 0.01}, {"metallic": 0, "alpha_ggx": 0.03}
    records = [
        {"object_id": 0, "name": "body", **chrome},
        {"object_id": 4, "name": "plate", **glaze},
        {"object_id": 5, "name": "spout", **chrome},
    ]
    path = tmp_path / "materials.json"
    path.write_text(json.dumps(records))
    parts = list(read_true_parts(path).values())
    assert parts[0].material == parts[2].material != parts[1].material
    part = np.repeat([0, 1, 2], [30, 20, 5])
    true = np.float32([0.1, 0.17, 0.1])[part]
    # the spout alone is told rougher than the plate, but chrome in all is not
    told = np.float32([0.12, 0.16, 0.2])[part]
    assert roughness_rank(told, true, part, parts) == pytest.approx(1)
    assert roughness_rank(np.float32([0.2, 0.16, 0.2])[part], true, part, parts) == -1


def test_normals_without_a_surface_are_white(tmp_path: Path) -> None:
    photo = save(tmp_path / "r_0.png", 0, 0, 0, 0)
    save(tmp_path / "r_0_normal.png", 128, 128, 128, 0)
    truth = read_view_truth(view_truth_files(photo))
    assert truth.normal is not None and (truth.normal == 1).all()
    assert truth.foreground is not None and not truth.foreground.any()


def test_shiny_blenders_opaque_normals_take_the_alpha_file(tmp_path: Path) -> None:
    photo = save(tmp_path / "r_0.png", 9, 9, 9)
    save(tmp_path / "r_0_normal.png", 255, 128, 128)
    save(tmp_path / "r_0_alpha.png", 255)
    truth = read_view_truth(view_truth_files(photo))
    assert truth.foreground is not None and truth.foreground.all()
    assert truth.alpha is not None and (truth.alpha == 1).all()
    (tmp_path / "r_0_alpha.png").unlink()
    again = read_view_truth(view_truth_files(photo))
    assert again.alpha is None and again.foreground is not None and again.foreground.all()


def test_neros_depth_is_in_fifteenths_and_far_is_nothing(tmp_path: Path) -> None:
    photo = save(tmp_path / "rgb" / "0.png", 9, 9, 9)
    depth = np.full((6, 4), 65535, np.uint16)
    depth[0] = 65535 // 15 * 2
    (tmp_path / "depth").mkdir()
    Image.fromarray(depth).save(tmp_path / "depth" / "0-depth.png")
    truth = read_view_truth(view_truth_files(photo))
    assert truth.depth is not None
    assert np.allclose(truth.depth[0], 2) and (truth.depth[1:] == 0).all()
    assert truth.alpha is not None and np.array_equal(truth.alpha, truth.depth > 0)


def test_a_photo_alone_has_no_truth(tmp_path: Path) -> None:
    assert read_view_truth(view_truth_files(save(tmp_path / "a.png", 1, 2, 3))).size is None


@pytest.mark.parametrize("name", ["r_0_normal.png", "r_0_depth.npz"])
@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_file_is_named(tmp_path: Path, name: str, damage: bytes | None) -> None:
    photo = scene_photo(tmp_path)
    file = tmp_path / name
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    with pytest.raises(CorruptError, match=name):
        read_view_truth(view_truth_files(photo))


def test_a_depth_file_is_never_unpickled(tmp_path: Path) -> None:
    photo = scene_photo(tmp_path)
    np.savez(tmp_path / "r_0_depth.npz", allow_pickle=True, depth=np.array([{"a": 1}], object))
    with pytest.raises(CorruptError, match=r"r_0_depth\.npz"):
        read_view_truth(view_truth_files(photo))


def test_depths_that_are_not_finite_or_not_depths_are_refused(tmp_path: Path) -> None:
    photo = scene_photo(tmp_path)
    for depth in (np.full((6, 4), np.nan, np.float32), np.zeros((6, 4, 2), np.float32)):
        np.savez(tmp_path / "r_0_depth.npz", allow_pickle=False, depth=depth)
        with pytest.raises(CorruptError, match=r"r_0_depth\.npz"):
            read_view_truth(view_truth_files(photo))
    (tmp_path / "r_0_depth.npz").unlink()
    save(tmp_path / "r_0-depth.png", 7)
    with pytest.raises(CorruptError, match="16-bit grey"):
        read_view_truth(view_truth_files(photo))


def test_grey_normals_and_maps_of_different_sizes_are_refused(tmp_path: Path) -> None:
    photo = scene_photo(tmp_path)
    save(tmp_path / "r_0_normal.png", 128, 128, 255, size=(5, 4))
    with pytest.raises(InputError, match=r"r_0_normal.png 4 x 5.*r_0_depth.npz 4 x 6"):
        read_view_truth(view_truth_files(photo))
    save(tmp_path / "r_0_normal.png", 128)
    with pytest.raises(CorruptError, match="colour PNG of normals"):
        read_view_truth(view_truth_files(photo))


def test_true_surfaces_need_triangles_or_points(tmp_path: Path) -> None:
    corners = np.eye(3, dtype=np.float32)
    write_mesh(tmp_path / "empty.ply", corners, np.zeros((0, 3), np.int32))
    with pytest.raises(CorruptError, match="no triangles"):
        read_true_mesh(tmp_path / "empty.ply")
    write_ply(tmp_path / "points.ply", {n: corners[:, i] for i, n in enumerate("xyz")})
    assert np.array_equal(read_true_points(tmp_path / "points.ply"), corners)
    write_ply(tmp_path / "odd.ply", {"a": corners[:, 0]})
    with pytest.raises(CorruptError, match="no points"):
        read_true_points(tmp_path / "odd.ply")
    write_ply(tmp_path / "nan.ply", {n: corners[:, i] * np.nan for i, n in enumerate("xyz")})
    with pytest.raises(CorruptError, match="not finite"):
        read_true_points(tmp_path / "nan.ply")


def test_the_truth_of_a_data_set_is_part_of_its_fingerprint(tmp_path: Path) -> None:
    """A score must not outlive the truth that it was measured with."""
    frame = '{"file_path": "./train/r_0", "transform_matrix": [[1,0,0,0]]}'
    text = f'{{"camera_angle_x": 0.7, "frames": [{frame}]}}'
    (tmp_path / "transforms_train.json").write_text(text)
    scene_photo(tmp_path / "train")
    (tmp_path / "gt_mesh.ply").write_bytes(b"")
    names = [name for name, _ in Capture((tmp_path,)).files()]
    assert names == [
        "gt_mesh.ply",
        "train/r_0.png",
        "train/r_0_depth.npz",
        "train/r_0_normal.png",
        "transforms_train.json",
    ]
