"""The target print: one closed body in millimetres."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from orders import METRES, dented, order_in
from solids import sphere, two_pieces, with_fin

from refdgs_pipe.artifacts.asset import Delivery
from refdgs_pipe.errors import MeshError, OutOfMemory
from refdgs_pipe.export.targets import delivering
from refdgs_pipe.export.targets.delivering import deliver
from refdgs_pipe.export.targets.order import Order
from refdgs_pipe.export.targets.printing import fault_of, read_three_mf, three_mf_faults, write_body


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    """A ball that is open below."""
    return order_in(tmp_path_factory.mktemp("asset"), dented(24, 256, is_open=True))


@pytest.fixture(scope="module")
def made(order: Order) -> Delivery:
    return deliver("print", order, pytest.fail)


def test_an_open_surface_becomes_a_closed_body(order: Order, made: Delivery) -> None:
    assert order.product.is_open
    path = order.folder / "targets/print/asset.3mf"
    assert three_mf_faults(path) == []
    vertices, faces, _ = read_three_mf(path)
    assert fault_of(vertices, faces) is None
    assert "holes closed" in str(made.figures["closed_by"])


def test_the_body_is_in_millimetres_with_z_up(order: Order, made: Delivery) -> None:
    vertices, _, unit = read_three_mf(order.folder / "targets/print/asset.3mf")
    assert unit == "millimeter"
    sides = np.ptp(order.product.vertices, axis=0) * 1000  # x, y (up), z
    np.testing.assert_allclose(np.ptp(vertices, axis=0), sides[[0, 2, 1]], rtol=1e-4)
    assert abs(vertices[:, 2].min()) < 1e-6
    # the cut is at the bottom: near the plate the body is wide and flat
    low = vertices[vertices[:, 2] < 0.05 * np.ptp(vertices[:, 2])]
    assert np.ptp(low[:, 0]) > 0.5 * 1000 * METRES


def test_the_volume_is_that_of_the_cut_ball(order: Order, made: Delivery) -> None:
    # a ball of radius 100 mm without its cap below z = -0.75 r, dents aside
    whole, height = 4 / 3 * np.pi, 0.25
    cap = np.pi * height**2 * (3 - height) / 3
    assert float(made.figures["volume_cm3"]) == pytest.approx((whole - cap) * 1000, rel=0.1)


def test_the_same_body_gives_the_same_bytes(order: Order, made: Delivery, tmp_path: Path) -> None:
    deliver("print", order_in(tmp_path, dented(24, 256, is_open=True)), pytest.fail)
    name = "targets/print/asset.3mf"
    assert (tmp_path / name).read_bytes() == (order.folder / name).read_bytes()


def test_an_unknown_size_is_said_with_what_is_assumed(tmp_path: Path) -> None:
    warned: list[str] = []
    order = order_in(tmp_path, dented(12, 64), unknown="unknown: exported 1 m long")
    made = deliver("print", order, warned.append)
    assert "real size is unknown" in warned[0] and "--size" in warned[0]
    assert any("unknown" in note for note in made.notes)


@pytest.mark.parametrize("bad", [with_fin(sphere(8)), two_pieces(sphere(8))])
def test_fins_and_pieces_still_give_a_closed_body(bad: object, tmp_path: Path) -> None:
    written = write_body(tmp_path, bad.vertices.astype(np.float64), bad.faces)  # type: ignore[attr-defined]
    assert written["file"] == "asset.3mf"
    assert three_mf_faults(tmp_path / "asset.3mf") == []


def test_faults_of_bodies_are_found_out(tmp_path: Path) -> None:
    ball = sphere(6)
    points, faces = ball.vertices.astype(np.float64), ball.faces
    assert fault_of(points, faces) is None
    assert "one triangle only" in str(fault_of(points, faces[1:]))
    turned = np.concatenate([faces[:1, ::-1], faces[1:]])
    assert "opposite ways" in str(fault_of(points, turned))
    (tmp_path / "no.3mf").write_bytes(b"no")
    assert "not a 3MF" in three_mf_faults(tmp_path / "no.3mf")[0]
    with zipfile.ZipFile(tmp_path / "empty.3mf", "w") as package:
        package.writestr("3D/3dmodel.model", "<model/>")
    assert three_mf_faults(tmp_path / "empty.3mf") == [
        "its unit is , not millimeter",
        "no triangle is left",
    ]


def failing(error: Exception) -> object:
    def make(order: Order, folder: Path) -> None:
        (folder / "half.3mf").write_bytes(b"")
        raise error

    return make


def test_a_target_that_cannot_be_made_is_a_warning_and_leaves_nothing(
    order: Order, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(delivering._MAKERS, "ar", failing(MeshError("it has no surface")))
    said: list[str] = []
    made = deliver("ar", order, said.append)
    assert said == ["target ar was not made: it has no surface"]
    assert (made.files, made.summary, made.notes) == ((), "not made", ("it has no surface",))
    assert not (order.folder / "targets/ar").exists()


def test_a_target_for_which_memory_is_lacking_ends_the_export(
    order: Order, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(delivering._MAKERS, "web", failing(OutOfMemory("4 GB are needed")))
    with pytest.raises(OutOfMemory):
        deliver("web", order, pytest.fail)
