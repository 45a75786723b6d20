"""Surfels as a splat PLY in the 2DGS convention, for splat viewers."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import ShapeError
from refdgs_pipe.files.ply import write_ply

F32 = NDArray[np.float32]

_SH_DC = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))


def write_splats(
    path: Path, *, means: F32, quats: F32, scales: F32, opacities: F32, colors: F32
) -> None:
    """Write surfels, in the world frame they are in.

    Args:
        means: (N, 3); quats: (N, 4) unit, w x y z; scales: (N, 2) standard deviations.
        opacities: (N,) in (0, 1); colors: (N, 3) linear.

    Raises:
        ShapeError: arrays of different lengths.
    """
    counts = {len(values) for values in (means, quats, scales, opacities, colors)}
    if len(counts) != 1:
        raise ShapeError(f"surfel arrays have {sorted(counts)} rows: give one length")
    normals = _normals(quats)
    dc = (srgb_from_linear(colors) - 0.5) / _SH_DC
    opacity = np.clip(opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    columns = {
        **_named(("x", "y", "z"), means),
        **_named(("nx", "ny", "nz"), normals),
        **_named(("f_dc_0", "f_dc_1", "f_dc_2"), dc),
        "opacity": np.log(opacity / (1 - opacity)).astype(np.float32),
        **_named(("scale_0", "scale_1"), np.log(np.maximum(scales, 1e-12))),
        **_named(("rot_0", "rot_1", "rot_2", "rot_3"), quats),
    }
    write_ply(path, columns, comments=["SplatRenderMode: 2dgs"])


def _named(names: tuple[str, ...], values: F32) -> dict[str, F32]:
    return {name: values[:, i].astype(np.float32) for i, name in enumerate(names)}


def _normals(quats: F32) -> F32:
    """(N, 3) third column of the rotations."""
    w, x, y, z = quats.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
