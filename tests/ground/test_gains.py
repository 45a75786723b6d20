"""Photos that were exposed and balanced unequally, made alike by the ground that they show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from printed_ground import PLANE, blots, capture, right_model

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.ground.gains import factors, gains_of
from refdgs_pipe.sfm.on_ground import evened

TAKEN = {"IMG_02": (1.4, 1.4, 1.4), "IMG_05": (0.7, 0.75, 0.65), "IMG_09": (1.0, 1.1, 0.9)}


def exposed(folder: Path, taken: dict[str, tuple[float, float, float]]) -> None:
    """Multiply the light of some photos."""
    for name, gain in taken.items():
        with Image.open(folder / f"{name}.png") as image:
            linear = linear_from_srgb(np.asarray(image, np.float32) / 255)
        pixels = (srgb_from_linear(linear * np.float32(gain)) * 255).round().astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"{name}.png")


def dim() -> np.ndarray:
    return 0.6 * blots()


def test_unequal_photos_are_evened(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, dim())
    before = {c.name: load_photo(views, right_model(cameras), c).rgb for c in cameras}
    exposed(tmp_path, TAKEN)
    model = evened(views, right_model(cameras))
    assert set(model.gains) == {c.name for c in cameras}
    for name, gain in model.gains.items():
        np.testing.assert_allclose(np.array(gain) * TAKEN.get(name, (1, 1, 1)), 1, atol=0.03)
    for camera in cameras:
        apart = np.abs(load_photo(views, model, camera).rgb - before[camera.name])
        assert np.median(apart) < 0.01
    plain = load_photo(views, model, cameras[2], evened=False).rgb
    assert np.median(np.abs(plain - before["IMG_02"])) > 0.03


def test_equal_photos_stay_as_they_are(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, dim())
    assert evened(views, right_model(cameras)).gains == {}
    exposed(tmp_path, {"IMG_02": (1.03, 1.03, 1.03)})
    assert gains_of(views, right_model(cameras), PLANE) == {}


def test_the_number_of_threads_changes_nothing(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, dim())
    exposed(tmp_path, TAKEN)
    model = right_model(cameras)
    assert gains_of(views, model, PLANE, 2) == gains_of(views, model, PLANE, 1) != {}


def test_light_that_moves_over_the_ground_is_no_exposure() -> None:
    """Each photo's lamp shines on another part of the ground, as a flash does."""
    y, x = np.mgrid[0:64, 0:64] / 64 - 0.5
    turn = np.arange(8) * np.pi / 4
    lit = np.stack([1.5 * (x * np.cos(t) + y * np.sin(t)) for t in turn])
    seen = np.repeat(lit[..., None], 3, -1).astype(np.float32)
    _, apart = factors(seen)
    assert apart.min() > 0.1
    _, apart = factors(np.zeros_like(seen) + turn[:, None, None, None].astype(np.float32))
    assert apart.max() < 1e-6


def test_photos_under_a_light_that_moves_are_not_evened(tmp_path: Path) -> None:
    """Most are lit from a side of their own. The other three would tell of their exposure."""
    views, cameras = capture(tmp_path, dim())
    for i, camera in enumerate(cameras):
        path = tmp_path / f"{camera.name}.png"
        with Image.open(path) as image:
            linear = linear_from_srgb(np.asarray(image, np.float32) / 255)
        ramp = np.linspace(0.6, 1.5, linear.shape[1], dtype=np.float32)[None, :, None]
        sides = ramp if i % 2 else ramp[:, ::-1]
        lit = linear * (sides if i > 2 else (1.0, 1.3, 0.8)[i])
        Image.fromarray((srgb_from_linear(lit) * 255).round().astype(np.uint8)).save(path)
    assert evened(views, right_model(cameras)).gains == {}


def test_a_photo_without_the_ground_has_no_factor() -> None:
    seen = np.zeros((5, 32, 32, 3), np.float32)
    seen[3] = np.nan
    seen[1] += 0.5
    logs, apart = factors(seen)
    np.testing.assert_allclose(logs[:, 0], [0, 0.5, 0, 0, 0], atol=1e-6)
    assert np.isinf(apart[3]) and (apart[[0, 1, 2, 4]] < 1e-6).all()
    logs, apart = factors(np.full((3, 8, 8, 3), np.nan, np.float32))
    assert not logs.any() and np.isinf(apart).all()


def test_factors_are_kept_with_the_model(tmp_path: Path) -> None:
    _, cameras = capture(tmp_path, dim())
    model = replace(right_model(cameras), gains={"IMG_03": (1.25, 1.0, 0.5)})
    model.save(tmp_path / "model")
    assert SparseModel.load(tmp_path / "model").gains == model.gains


@pytest.mark.parametrize("bad", ["[1, 2]", "[1, 1, 0]", "[1, 1, NaN]", '"red"'])
def test_damaged_factors_are_refused(tmp_path: Path, bad: str) -> None:
    _, cameras = capture(tmp_path, dim())
    replace(right_model(cameras), gains={"IMG_03": (1.0, 1.0, 1.0)}).save(tmp_path / "model")
    path = tmp_path / "model" / "model.json"
    text = path.read_text()
    start = text.index("[", text.index('"gains"'))
    path.write_text(text[:start] + bad + text[text.index("]", start) + 1 :])
    with pytest.raises(CorruptError, match=r"model\.json"):
        SparseModel.load(tmp_path / "model")
