"""LPIPS is its formula, and only takes weights that fit. Its own weights are not ours to ship."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from refdgs_pipe.errors import InputError
from refdgs_pipe.evaluation.lpips import Lpips, digest_of, load_lpips

SHAPES = {
    0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128),
    10: (256, 128), 12: (256, 256), 14: (256, 256),
    17: (512, 256), 19: (512, 512), 21: (512, 512),
    24: (512, 512), 26: (512, 512), 28: (512, 512),
}  # fmt: skip
SLICES = {0: 1, 2: 1, 5: 2, 7: 2, 10: 3, 12: 3, 14: 3, 17: 4, 19: 4, 21: 4, 24: 5, 26: 5, 28: 5}


def weights() -> dict[str, torch.Tensor]:
    """VGG16's layers at random, as torchvision names them, and linear layers of ones."""
    chance = torch.Generator().manual_seed(0)
    found = {}
    for index, (wide, before) in SHAPES.items():
        scale = (2 / (9 * before)) ** 0.5
        found[f"features.{index}.weight"] = (
            torch.randn(wide, before, 3, 3, generator=chance) * scale
        )
        found[f"features.{index}.bias"] = torch.randn(wide, generator=chance) * 0.1
    for block, wide in enumerate((64, 128, 256, 512, 512)):
        found[f"lin{block}.model.1.weight"] = torch.rand(1, wide, 1, 1, generator=chance)
    return found


def by_the_book(values: dict[str, torch.Tensor], a: np.ndarray, b: np.ndarray) -> float:
    """The paper's equation 1, layer by layer with torch's modules, as torchvision builds VGG16."""
    layers: list[torch.nn.Module] = []
    before = 3
    for item in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if item == 0:
            layers.append(torch.nn.MaxPool2d(2, 2))
            continue
        layers += [torch.nn.Conv2d(before, item, 3, padding=1), torch.nn.ReLU()]
        before = item
    net = torch.nn.Sequential(*layers)
    net.load_state_dict({k.removeprefix("features."): v for k, v in values.items() if "fea" in k})
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    total = 0.0
    x, y = ((torch.from_numpy(i).permute(2, 0, 1) - shift) / scale for i in (a, b))
    x, y = x[None], y[None]
    taps = {3: 0, 8: 1, 15: 2, 22: 3, 29: 4}
    with torch.no_grad():
        for i, layer in enumerate(net):
            x, y = layer(x), layer(y)
            if i in taps:
                u, v = (torch.nn.functional.normalize(t, dim=1, eps=1e-10) for t in (x, y))
                w = values[f"lin{taps[i]}.model.1.weight"]
                total += float(((u - v) ** 2 * w.view(1, -1, 1, 1)).sum(1).mean())
    return total


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lpips") / "vgg.safetensors"
    save_file(weights(), path)
    return path


def test_the_distance_is_the_papers_formula(file: Path) -> None:
    chance = np.random.default_rng(1)
    a, b = chance.random((2, 32, 48, 3), np.float32)
    lpips = Lpips(file)
    assert lpips(a, a) == 0
    assert lpips(a, b) == pytest.approx(by_the_book(weights(), a, b), rel=1e-4)
    assert lpips(a, b) == pytest.approx(lpips(b, a), rel=1e-5)


def test_the_names_of_the_package_lpips_are_understood(file: Path, tmp_path: Path) -> None:
    named = {}
    for name, value in weights().items():
        if name.startswith("features."):
            _, index, kind = name.split(".")
            name = f"net.slice{SLICES[int(index)]}.{index}.{kind}"
        named[name] = value
    save_file(named, tmp_path / "other.safetensors")
    a, b = np.random.default_rng(1).random((2, 16, 16, 3), np.float32)
    assert Lpips(tmp_path / "other.safetensors")(a, b) == Lpips(file)(a, b)


def test_only_the_file_that_was_named_is_used(file: Path, tmp_path: Path) -> None:
    assert load_lpips("", "") is None
    assert load_lpips(str(file), digest_of(file)) is not None
    with pytest.raises(InputError, match="eval --lpips-weights"):
        load_lpips(str(file), "")
    with pytest.raises(InputError, match="cannot be read"):
        load_lpips(str(tmp_path / "gone"), "")


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"\x80\x04pickle")
    with pytest.raises(InputError, match="not a readable safetensors file"):
        Lpips(path)
    values = weights()
    del values["lin2.model.1.weight"]
    save_file(values, path)
    with pytest.raises(InputError, match=r"lin2\.model\.1\.weight .* nothing found"):
        Lpips(path)
    save_file(weights() | {"features.5.bias": torch.zeros(3)}, path)
    with pytest.raises(InputError, match=r"features\.5\.bias of shape \(128,\) expected, \(3,\)"):
        Lpips(path)
