"""The target game: levels of detail on packed textures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from orders import dented, order_in
from scipy.spatial import cKDTree

from refdgs_pipe.artifacts.asset import Delivery
from refdgs_pipe.export.glb_reading import read_glb
from refdgs_pipe.export.targets import game as module
from refdgs_pipe.export.targets.delivering import deliver
from refdgs_pipe.export.targets.difference import studio_psnr
from refdgs_pipe.export.targets.order import Order
from refdgs_pipe.export.validate import glb_faults


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    return order_in(tmp_path_factory.mktemp("asset"), dented())


@pytest.fixture(scope="module")
def game(order: Order) -> Delivery:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TRIANGLES", (6000, 2000, 7000))
        return deliver("game", order, pytest.fail)


def test_levels_have_their_triangles_and_pass_their_check(order: Order, game: Delivery) -> None:
    folder = order.folder / "targets/game"
    counts = [game.figures[f"lod{i}_triangles"] for i in range(2)]
    assert 0.95 * 6000 <= int(counts[0]) <= 6000 and 0.95 * 2000 <= int(counts[1]) <= 2000
    assert not (folder / "asset_lod2.glb").exists()  # the mesh has less than 7000
    for number, count in enumerate(counts):
        path = folder / f"asset_lod{number}.glb"
        assert glb_faults(path) == []
        assert len(read_glb(path, like=order.product).faces) == count


def test_the_distance_of_a_level_is_measured(order: Order, game: Delivery) -> None:
    mean, far = (game.figures[f"lod1_off_{name}_percent"] for name in ("mean", "95"))
    assert isinstance(mean, float) and isinstance(far, float)
    shown = read_glb(order.folder / "targets/game/asset_lod1.glb", like=order.product)
    # to the coarse vertices is further than to its surface: an independent upper bound
    apart, _ = cKDTree(shown.vertices).query(order.product.vertices)
    diagonal = np.linalg.norm(np.ptp(order.product.vertices, axis=0))
    assert 0 < mean < far < 100 * np.percentile(apart, 95) / diagonal
    assert far < 0.5  # chords of a ball with 2000 triangles: sagitta 0.1 to 0.2 % of the diagonal


def test_a_coarse_level_keeps_texture_seams_and_normals(order: Order, game: Delivery) -> None:
    shown = read_glb(order.folder / "targets/game/asset_lod1.glb", like=order.product)
    assert studio_psnr(shown, order.product) > 28  # without the normal map it has 24
    along = (shown.normals * shown.tangents[:, :3]).sum(1)
    assert np.abs(along).max() < 0.05


def test_the_packed_texture_has_occlusion_roughness_and_metal(order: Order, game: Delivery) -> None:
    path = order.folder / "targets/game/textures/occlusion_roughness_metallic.png"
    blue, green, red = cv2.split(cv2.imread(str(path)))
    np.testing.assert_array_equal(red, order.product.occlusion)
    np.testing.assert_array_equal(green, order.product.roughness)
    np.testing.assert_array_equal(blue, order.product.metallic)
    assert "targets/game/asset_lod0.glb" in game.main_files
    assert not any("textures" in name for name in game.main_files)


def test_a_small_mesh_has_one_level_and_says_so(tmp_path: Path) -> None:
    made = deliver("game", order_in(tmp_path, dented(12, 64)), pytest.fail)
    assert made.main_files == ("targets/game/asset_lod0.glb",)
    assert made.figures["lod0_off_95_percent"] == 0 and "one level" in made.notes[0]
