"""The target web: small, valid, and nearly the same picture."""

import json
import shutil
import stat
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orders import dented, order_in

from refdgs_pipe.artifacts.asset import Asset, Delivery
from refdgs_pipe.export.glb_reading import read_glb, split_glb
from refdgs_pipe.export.targets import packing
from refdgs_pipe.export.targets.delivering import deliver
from refdgs_pipe.export.targets.difference import studio_psnr
from refdgs_pipe.export.targets.order import Order, with_textures
from refdgs_pipe.export.validate import glb_faults

VALIDATOR = Path(__file__).parent / "validate_gltf.js"


@pytest.fixture(autouse=True)
def no_packer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What this machine has installed must not matter."""
    monkeypatch.setattr(packing, "found", lambda: None)


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    return order_in(tmp_path_factory.mktemp("asset"), dented())


@pytest.fixture(scope="module")
def web(order: Order) -> Delivery:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "found", lambda: None)
        return deliver("web", order, pytest.fail)


def test_the_file_for_the_web_is_a_fifth_of_the_asset_and_sound(
    order: Order, web: Delivery
) -> None:
    path = order.folder / "targets/web/asset.glb"
    assert web.files == ("targets/web/asset.glb",)
    assert glb_faults(path) == []
    assert path.stat().st_size <= 0.2 * (order.folder / "asset.glb").stat().st_size
    assert web.figures["bytes"] == path.stat().st_size


def test_the_file_for_the_web_shows_nearly_the_same(order: Order, web: Delivery) -> None:
    shown = read_glb(order.folder / "targets/web/asset.glb", like=order.product)
    assert studio_psnr(shown, order.product) > 30  # without the normal map it has 24
    for side in (shown, order.product):
        np.testing.assert_allclose(
            [side.vertices.min(0), side.vertices.max(0)],
            [order.product.vertices.min(0), order.product.vertices.max(0)],
            atol=1e-3,  # metres, of 0.2
        )


@pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")
def test_khronos_validator_accepts_the_file_for_the_web(order: Order, web: Delivery) -> None:
    path = order.folder / "targets/web/asset.glb"
    run = subprocess.run(["node", str(VALIDATOR), str(path)], capture_output=True, text=True)
    if run.returncode == 3:
        pytest.skip("the npm package gltf-validator is not installed")
    report = json.loads(run.stdout)
    counts = [report["issues"][k] for k in ("numErrors", "numWarnings")]
    assert counts == [0, 0], report["issues"]["messages"]


def test_extensions_are_declared_as_required(order: Order, web: Delivery) -> None:
    document, _ = split_glb((order.folder / "targets/web/asset.glb").read_bytes())
    assert set(document["extensionsRequired"]) == {"KHR_mesh_quantization", "EXT_texture_webp"}


def test_without_a_packer_the_result_says_what_to_install(web: Delivery) -> None:
    assert "gltf-transform nor gltfpack is on the PATH" in web.notes[0]
    assert "npm install" in web.notes[0]


def test_a_packer_that_fails_is_named_and_leaves_the_plain_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "gltfpack"
    program.write_text("#!/bin/sh\necho out of luck >&2\nexit 5\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(packing, "found", lambda: (packing.PACKERS[1], str(program)))
    made = deliver("web", order_in(tmp_path, dented(12, 64)), lambda _: None)
    assert "gltfpack ended with exit code 5: out of luck" in made.notes[0]
    assert made.files == ("targets/web/asset.glb",)


def test_a_packer_that_loses_triangles_is_found_out(order: Order, tmp_path: Path) -> None:
    path = order.folder / "asset.glb"
    assert "not packed with meshopt" in packing.packed_faults(path, path)[0]
    (tmp_path / "cut.glb").write_bytes(path.read_bytes()[:-8])
    assert "structure" in packing.packed_faults(tmp_path / "cut.glb", path)[0]


def test_a_large_loss_against_the_photos_is_a_warning(tmp_path: Path) -> None:
    warned: list[str] = []
    order = replace(order_in(tmp_path, dented(12, 64)), loss=lambda _: 0.81)
    made = deliver("web", order, warned.append)
    assert made.figures["loss_db"] == 0.81
    assert any("0.81 dB worse than asset.glb" in text for text in warned)


def test_smaller_textures_keep_colours_and_unit_normals(order: Order) -> None:
    small = with_textures(order.product, 128)
    assert small.base_color.shape == (128, 128, 3) and small.roughness.shape == (128, 128)
    for name in ("base_color", "roughness", "normal"):
        before, after = (getattr(p, name).astype(float) for p in (order.product, small))
        blocks = before.reshape(128, 8, 128, 8, *before.shape[2:]).mean((1, 3))
        assert np.abs(after - blocks).mean() < 2
    length = np.linalg.norm(small.normal / 127.5 - 1, axis=-1)
    assert np.abs(length - 1).max() < 0.02


def test_what_was_made_for_single_uses_survives_the_round_trip(
    order: Order, web: Delivery, tmp_path: Path
) -> None:
    asset = Asset.of(order.folder, faces=1, texture_size=1024, targets=(web,))
    asset.save(tmp_path)
    assert Asset.load(tmp_path).targets == (web,)
    plain = Asset.of(order.folder, faces=1, texture_size=1024)
    plain.save(tmp_path)
    assert 'targets":' not in (tmp_path / "asset.json").read_text()
