"""How tensors and cameras are handed to the native functions."""

from torch import Tensor

from refdgs_pipe.ops.rasterize import Pinhole


def image(tensor: Tensor | None) -> tuple[int, list[int]]:
    """Address and strides (row, column, channel) of (H, W) or (H, W, C); None is address 0."""
    if tensor is None:
        return 0, [0, 0, 0]
    return tensor.data_ptr(), [*tensor.stride(), 0][:3]


def table(tensor: Tensor) -> tuple[int, list[int]]:
    """Address and strides (row, column) of (P,) or (P, C)."""
    return tensor.data_ptr(), [*tensor.stride(), 0][:2]


def lens_and_rotation(camera: Pinhole) -> list[float]:
    """fx, fy, cx, cy in pixels, and the rows of the rotation from the camera to the world."""
    rotation = camera.cam_from_world[:3, :3].detach().double().T.flatten().tolist()
    return [camera.fx, camera.fy, camera.cx, camera.cy, *rotation]


def lens(camera: Pinhole) -> int:
    """Address of the camera's numbers on the GPU, or 0."""
    return 0 if camera.lens is None else camera.lens.data_ptr()
