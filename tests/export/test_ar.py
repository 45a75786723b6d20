"""The target ar: within the limits of phones."""

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from orders import dented, order_in

from refdgs_pipe.artifacts.asset import Delivery
from refdgs_pipe.export.glb_reading import read_glb
from refdgs_pipe.export.targets import ar as module
from refdgs_pipe.export.targets.delivering import deliver
from refdgs_pipe.export.targets.order import Order
from refdgs_pipe.export.validate import glb_faults, usd_faults


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    return order_in(tmp_path_factory.mktemp("asset"), dented(24, 256))


@pytest.fixture(scope="module")
def ar(order: Order) -> Delivery:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TRIANGLES", 1000)
        patch.setattr(module, "TEXTURE", 128)
        return deliver("ar", order, pytest.fail)


def test_the_files_for_ar_pass_their_checks(order: Order, ar: Delivery) -> None:
    assert ar.files == ("targets/ar/asset.glb", "targets/ar/asset.usdz")
    assert glb_faults(order.folder / ar.files[0]) == []
    assert usd_faults(order.folder / ar.files[1]) == []


def test_the_usdz_is_within_the_limits_of_quick_look(order: Order, ar: Delivery) -> None:
    from pxr import Usd, UsdGeom

    path = order.folder / ar.files[1]
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
    counts = stage.GetPrimAtPath("/object/mesh").GetAttribute("faceVertexCounts").Get()
    assert 900 < len(counts) <= 1000 and ar.figures["triangles"] == len(counts)
    with zipfile.ZipFile(path) as package:
        pictures = [n for n in package.namelist() if not n.endswith(".usdc")]
        assert len(pictures) == 5
        for name in pictures:
            data = np.frombuffer(package.read(name), np.uint8)
            picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            assert picture.shape[:2] == (128, 128) and picture.dtype == np.uint8


def test_the_glb_for_phones_loses_texels_until_it_fits(
    order: Order, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = (order.folder / "asset.glb").stat().st_size
    monkeypatch.setattr(module, "GLB_BYTES", round(0.9 * whole))
    monkeypatch.setattr(module, "_LEAST_TEXTURE", 64)
    made = deliver("ar", order_in(tmp_path, dented(24, 256)), pytest.fail)
    path = tmp_path / "targets/ar/asset.glb"
    assert path.stat().st_size <= 0.9 * whole
    assert made.figures["texture_size"] == 256 and made.figures["glb_texture_size"] == 128
    assert len(read_glb(path, like=order.product).base_color) == 128


def test_an_unknown_size_is_said_where_size_matters(tmp_path: Path) -> None:
    order = order_in(tmp_path, dented(12, 64), unknown="unknown: exported 1 m long")
    made = deliver("ar", order, pytest.fail)
    assert "unknown" in made.notes[0]
