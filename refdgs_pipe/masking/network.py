"""A segmentation network of the user's, run by onnxruntime. Called in a child process.

A network's file is not trusted: the child has a limit of memory and of time, an empty folder to
work in, one thread, and only the CPU.
"""

import os
import resource
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import InputError
from refdgs_pipe.masking.onnx_file import read_network
from refdgs_pipe.masking.settings import MasksParams

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

SIDE = 1024  # longest side of a photo, where the network takes any size
STEP = 32  # of which such sides are multiples
LEAST_SIDE, MOST_SIDE = 16, 4096  # px, of pictures that go in and come out
SLACK = 0.05  # by which probabilities may leave 0..1 by resampling; more are logits
FARTHEST = 60.0  # logits beyond are as good as certain
ONE = 1e-3  # by which two probabilities may miss it
PHOTO_S = 600  # for one photo, and to load the network
TRIAL = (768, 1024)  # rows and columns of the photo that a network is tried on
SHAPES = "(1, 1, h, w), (1, 2, h, w), (1, h, w) or (h, w), float"

_RANGES = {  # setting -> mean and deviation of red, green and blue
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "0..1": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "-0.5..0.5": ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0)),
    "-1..1": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
}


@dataclass(frozen=True)
class Network:
    """What network to run.

    Args:
        file: ONNX.
        digest: of its content.
        feeds: what it is fed, as the setting `masks.model_input` says.
    """

    file: Path
    digest: str
    feeds: str

    @classmethod
    def of(cls, params: MasksParams) -> Self:
        """The network that settings name."""
        return cls(Path(params.model), params.model_digest, params.model_input)


def try_network(network: Network) -> None:
    """Load a network and run it on a grey picture; for a child process.

    Raises:
        InputError: it cannot be used.
    """
    with _confined():
        model = Model(network)
        model.answer(np.full((*model.size(TRIAL), 3), 0.5, np.float32), "a grey picture")


def answers(
    network: Network,
    views: Views,
    model: SparseModel,
    progress: Callable[[str, int, int], None],
) -> list[U8]:
    """The probability of the object in each undistorted photo; for a child process.

    Returns:
        (h, w) for each camera of the model, at most 1024 pixels long; 255 is certain.

    Raises:
        InputError: the network cannot be used.
        CorruptError: a photo is missing or damaged.
    """
    with _confined():
        loaded, planes = Model(network), []
        for i, camera in enumerate(model.cameras):
            progress("the network's masks", i, len(model.cameras))
            signal.alarm(PHOTO_S)
            rows, columns = loaded.size((camera.height, camera.width))
            scale = min(1.0, max(rows / camera.height, columns / camera.width))
            rgb = load_photo(views, model, camera, scale=scale).rgb
            plane = loaded.answer(rgb, views[camera.name].source or camera.name)
            planes.append(plane.clip(-FARTHEST, FARTHEST).astype(np.float16))
    return probabilities(planes)


def probabilities(planes: list[NDArray[np.float16]]) -> list[U8]:
    """(h, w) from 0 to 255: of logits, if any of the values is clearly outside of 0..1."""
    least, most = min(float(p.min()) for p in planes), max(float(p.max()) for p in planes)
    are_logits = least < -SLACK or most > 1 + SLACK
    out = []
    for plane in planes:
        values = plane.astype(np.float32)
        share = 1 / (1 + np.exp(-values)) if are_logits else values.clip(0, 1)
        out.append(np.rint(255 * share).astype(np.uint8))
    return out


class Model:
    """A network that is loaded.

    Raises:
        InputError: onnxruntime is missing, or the file is no network that can be used.
    """

    def __init__(self, network: Network) -> None:
        self.label = str(network.file)
        mean, deviation = _RANGES[network.feeds]
        self.mean, self.deviation = np.array(mean, np.float32), np.array(deviation, np.float32)
        data = read_network(network.file, network.digest)
        self.session = _session(data, self.label)
        self.name, self.sides = self._input()
        self.output = self._output()

    def size(self, photo: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of what the network is fed, for a photo with that many."""
        scale = min(1.0, SIDE / max(photo))
        free = (max(STEP, STEP * round(scale * side / STEP)) for side in photo)
        rows, columns = (own or side for own, side in zip(self.sides, free, strict=True))
        return rows, columns

    def answer(self, rgb: F32, photo: str) -> F32:
        """(h, w) probabilities or logits of the object, at most 1024 pixels long.

        Args:
            rgb: (H, W, 3) sRGB in [0, 1].
            photo: how messages call it.

        Raises:
            InputError: the network fails, or its answer has another shape or is no number.
        """
        rows, columns = self.size(rgb.shape[:2])
        fed = (_resized(rgb, columns, rows) - self.mean) / self.deviation
        planes = np.ascontiguousarray(fed.transpose(2, 0, 1)[None], np.float32)
        try:
            found = np.asarray(self.session.run([self.output], {self.name: planes})[0])
        except Exception as error:  # onnxruntime has no class of its own for its errors
            raise InputError(
                f"{self.label}: the network fails on {photo}, fed as (1, 3, {rows}, {columns}): "
                f"{_said(error)}. Try it with onnxruntime, and export it again"
            ) from None
        self._check_shape(list(found.shape), np.issubdtype(found.dtype, np.floating))
        if not np.isfinite(found).all():
            bad = int(found.size - np.isfinite(found).sum())
            raise InputError(
                f"{self.label}: {bad} of {found.size} values that it gives for {photo} are "
                "infinite or no numbers. Probabilities or logits are expected. Check "
                "masks.model_input, or export the network as float32"
            )
        plane = _one_plane(found.astype(np.float32))
        scale = SIDE / max(plane.shape)
        height, width = (max(1, round(scale * side)) for side in plane.shape)
        return plane if scale >= 1 else _resized(plane, width, height)

    def _input(self) -> tuple[str, list[int]]:
        """The input's name, and its rows and columns; 0 where it takes any."""
        inputs = self.session.get_inputs()
        told = ", ".join(f"{one.name} {one.type} {_shape(one.shape)}" for one in inputs)
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        fixed = [side if isinstance(side, int) else 0 for side in shape]
        if not (
            len(fixed) == 4
            and inputs[0].type == "tensor(float)"
            and fixed[0] in (0, 1)
            and fixed[1] in (0, 3)
            and all(side == 0 or LEAST_SIDE <= side <= MOST_SIDE for side in fixed[2:])
        ):
            raise InputError(
                f"{self.label}: takes {told or 'nothing'}. One input tensor(float) (1, 3, H, W) "
                f"is expected, with sides of {LEAST_SIDE} to {MOST_SIDE} pixels or of any length. "
                "Export the network so"
            )
        return inputs[0].name, fixed[2:]

    def _output(self) -> str:
        """The first output's name; what is known of its shape is checked."""
        outputs = self.session.get_outputs()
        if not outputs:
            raise InputError(f"{self.label}: gives nothing. The object's mask is expected")
        first, kinds = outputs[0], ("tensor(float)", "tensor(float16)", "tensor(double)")
        sides = [side if isinstance(side, int) else None for side in first.shape or []]
        if sides or first.type not in kinds:
            self._check_shape(sides or [None, None], first.type in kinds, first.type)
        return str(first.name)

    def _check_shape(self, shape: list[Any], is_float: bool, kind: str = "") -> None:
        """Refuse an answer that is no mask. Sides that are not known yet are None."""
        head, sides = shape[:-2], shape[-2:]
        good = [[], [1], [1, 1], [1, 2]]
        fits = any(
            len(head) == len(one) and all(a in (None, b) for a, b in zip(head, one, strict=True))
            for one in good
        )
        sized = all(side is None or LEAST_SIDE <= side <= MOST_SIDE for side in sides)
        if not (is_float and len(sides) == 2 and fits and sized):
            raise InputError(
                f"{self.label}: its first output is {_shape(shape)}{kind and f' {kind}'}. "
                f"{SHAPES}, is expected, with sides of {LEAST_SIDE} to {MOST_SIDE} pixels: "
                "probabilities or logits of the object. Export the network so"
            )


def _session(data: bytes, label: str) -> Any:
    """The network in onnxruntime: on the CPU, with one thread."""
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(missing_runtime(str(error))) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no class of its own for its errors
        raise InputError(
            f"{label}: onnxruntime {onnxruntime.__version__} cannot load this network: "
            f"{_said(error)}. Export it with ONNX's own operators, for an older opset if need be"
        ) from None


def missing_runtime(reason: str) -> str:
    """What to say where onnxruntime cannot be imported."""
    return (
        f"masks.model needs onnxruntime, which cannot be used ({reason}). Install it (`pip install "
        'onnxruntime`; it is the extra mask-model), or go without a network: --mask-model ""'
    )


@contextmanager
def _confined() -> Iterator[None]:
    """An empty folder to work in, no more memory than the machine has, and an end.

    SIGALRM ends the process, also within a library.
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    if hard == resource.RLIM_INFINITY or memory < hard:
        resource.setrlimit(resource.RLIMIT_AS, (memory, hard))
    before = Path.cwd()
    signal.alarm(PHOTO_S)
    with tempfile.TemporaryDirectory() as empty:
        os.chdir(empty)
        try:
            yield
        finally:
            signal.alarm(0)
            os.chdir(before)


def _one_plane(found: F32) -> F32:
    """(h, w) of an answer: one channel as it is; of two the probability of the second."""
    planes = found.reshape(-1, *found.shape[-2:])
    if len(planes) == 1:
        return np.asarray(planes[0], np.float32)
    within = planes.min() >= -ONE and planes.max() <= 1 + ONE
    if within and np.abs(planes.sum(0) - 1).max() <= ONE:
        return np.asarray(planes[1].clip(0, 1), np.float32)
    apart = (planes[1] - planes[0]).clip(-FARTHEST, FARTHEST)
    return np.asarray(1 / (1 + np.exp(-apart)), np.float32)


def _resized(image: F32, width: int, height: int) -> F32:
    """The image at another size; the same where it has that size."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = width <= image.shape[1] and height <= image.shape[0]
    way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=way), np.float32)


def _shape(sides: Any) -> str:
    return f"({', '.join('any' if side is None else str(side) for side in sides)})"


def _said(error: Exception) -> str:
    """What onnxruntime says, in one line without its own marks."""
    text = " ".join(str(error).split()).rpartition("[ONNXRuntimeError] : ")[2]
    return (text if len(text) <= 300 else f"{text[:300]}...").rstrip(".")
