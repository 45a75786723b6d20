"""LPIPS, the learned perceptual distance (Zhang et al. 2018), version 0.1 on VGG16.

The weights are not ours and do not come with the product: the user gives a file. As 3D Gaussian
splatting and its followers do, images in [0, 1] are fed where the network was made for [-1, 1];
figures are comparable with theirs and lower than the network's authors would report.
"""

import hashlib
import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refdgs_pipe.errors import InputError

F32 = NDArray[np.float32]

# torchvision's indices of VGG16's convolutions, in the five blocks that pooling ends.
_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
_WIDTHS = (64, 128, 256, 512, 512)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_CONVOLUTION = re.compile(r"(?:features|net\.slice[1-5])\.(\d+)\.(weight|bias)")
_LINEAR = re.compile(r"(?:lin|lins\.)(\d)\.model\.1\.weight")


def digest_of(path: Path) -> str:
    """The SHA-256 of a file of weights, hex.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: the weights of LPIPS cannot be read ({error}). Give another file, or go "
            'without: --set evaluate.lpips_weights=""'
        ) from None


def load_lpips(path: str, digest: str) -> "Lpips | None":
    """The network of a file with that content; None if no file is named.

    Raises:
        InputError: the file is not the one that was named, or not of the right kind.
    """
    if not path:
        return None
    if digest_of(Path(path)) != digest:
        raise InputError(
            f"{path}: its content is not what evaluate.lpips_digest names. "
            "Give the file with `refdgs-pipe eval --lpips-weights`, which notes both"
        )
    return Lpips(Path(path))


class Lpips:
    """The network with its weights, on the CPU.

    Args:
        path: safetensors with VGG16's convolutions as torchvision (`features.0.weight`) or the
            package lpips (`net.slice1.0.weight`) names them, and `lin0.model.1.weight` to `lin4`.

    Raises:
        InputError: not such a file.
    """

    def __init__(self, path: Path) -> None:
        self._convolutions: dict[tuple[int, str], Tensor] = {}
        self._linear: dict[int, Tensor] = {}
        for name, tensor in _read(path).items():
            if match := _CONVOLUTION.fullmatch(name):
                self._convolutions[int(match[1]), match[2]] = tensor.float()
            elif match := _LINEAR.fullmatch(name):
                self._linear[int(match[1])] = tensor.float()
        self._check(path)

    def __call__(self, image: F32, target: F32) -> float:
        """The distance of two (H, W, 3) sRGB images in [0, 1]; 0 for equal ones.

        Both sides must be at least 16 pixels long.
        """
        with torch.no_grad():
            pairs = zip(self._features(image), self._features(target), strict=True)
            return sum(
                float(functional.conv2d((a - b) ** 2, self._linear[block]).mean())
                for block, (a, b) in enumerate(pairs)
            )

    def _features(self, image: F32) -> list[Tensor]:
        """Each block's activations before pooling, unit length across channels."""
        planes = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
        shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
        x = (planes - shift) / scale
        out = []
        for block, layers in enumerate(_BLOCKS):
            x = functional.max_pool2d(x, 2) if block else x
            for index in layers:
                weight = self._convolutions[index, "weight"]
                x = functional.conv2d(x, weight, self._convolutions[index, "bias"], padding=1)
                x = functional.relu(x)
            out.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return out

    def _check(self, path: Path) -> None:
        """Every layer is there with its shape."""
        before = 3
        for block, (layers, width) in enumerate(zip(_BLOCKS, _WIDTHS, strict=True)):
            wanted: dict[str, tuple[tuple[int, ...], Tensor | None]] = {
                f"lin{block}.model.1.weight": ((1, width, 1, 1), self._linear.get(block))
            }
            for index in layers:
                weight, bias = (self._convolutions.get((index, k)) for k in ("weight", "bias"))
                wanted[f"features.{index}.weight"] = ((width, before, 3, 3), weight)
                wanted[f"features.{index}.bias"] = ((width,), bias)
                before = width
            for name, (shape, tensor) in wanted.items():
                if tensor is None or tuple(tensor.shape) != shape:
                    found = "nothing" if tensor is None else f"{tuple(tensor.shape)}"
                    raise InputError(
                        f"{path}: {name} of shape {shape} expected, {found} found. Give VGG16's "
                        "convolutions and LPIPS 0.1's linear layers in one safetensors file"
                    )


def _read(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        found: dict[str, Tensor] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: not a readable safetensors file ({error})") from None
    return found
