"""How tensors and cameras are handed to native functions. No other module takes addresses.

An address keeps no tensor alive: who calls a native function holds the tensors until it returns
(on a GPU, torch's allocator keeps freed memory in the order of the stream).
"""

from collections.abc import Iterable, Sequence

from torch import Tensor

from refdgs_pipe.ops.scene import Pinhole


def of(tensor: Tensor | None) -> int:
    """Where a tensor's first element is; None is address 0."""
    return 0 if tensor is None else tensor.data_ptr()


def each(tensors: Iterable[Tensor | None]) -> list[int]:
    """Address of each tensor."""
    return [of(tensor) for tensor in tensors]


def element(tensor: Tensor | None, index: int) -> int:
    """Where an element of a contiguous tensor is; None is address 0."""
    return 0 if tensor is None else tensor.data_ptr() + tensor.itemsize * index


def image(tensor: Tensor | None) -> tuple[int, list[int]]:
    """Address and strides (row, column, channel) of (H, W) or (H, W, C); None is address 0."""
    if tensor is None:
        return 0, [0, 0, 0]
    return of(tensor), [*tensor.stride(), 0][:3]


def table(tensor: Tensor) -> tuple[int, list[int]]:
    """Address and strides (row, column) of (P,) or (P, C)."""
    return of(tensor), [*tensor.stride(), 0][:2]


def sized_table(tensor: Tensor) -> tuple[int, list[int]]:
    """Address, strides (row, column) and number of columns of (P, C)."""
    return of(tensor), [*tensor.stride(), tensor.shape[1]]


def halves(parameters: Sequence[Tensor]) -> tuple[list[int], list[int]]:
    """Addresses of a network's weights, and of its biases, which follow them."""
    all_of_them = each(parameters)
    return all_of_them[: len(all_of_them) // 2], all_of_them[len(all_of_them) // 2 :]


def aligned(tensor: Tensor, size: int) -> Tensor:
    """The tensor, contiguous and starting at a multiple of `size` bytes; a copy if need be."""
    whole = tensor.contiguous()
    return whole.clone() if of(whole) % size else whole


def lens_and_rotation(camera: Pinhole) -> list[float]:
    """fx, fy, cx, cy in pixels, and the rows of the rotation from the camera to the world."""
    rotation = camera.cam_from_world[:3, :3].detach().double().T.flatten().tolist()
    return [camera.fx, camera.fy, camera.cx, camera.cy, *rotation]


def pose_and_lens(camera: Pinhole) -> list[float]:
    """The pose's rows, fx, fy, cx, cy and near. A pose on a GPU would be waited for."""
    pose: list[float] = camera.cam_from_world[:3].detach().double().flatten().tolist()
    return [*pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.near]


def lens(camera: Pinhole) -> int:
    """Address of the camera's numbers on the GPU, or 0."""
    return of(camera.lens)
