"""Where the truth lies in the world of a capture whose poses were found: told by its cameras."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.geometry import robust_similarity

F64 = NDArray[np.float64]

_LEAST = 3  # cameras not in a line fix a similarity


def read_true_centers(path: Path) -> dict[str, F64]:
    """Photo's name without folder and suffix -> (3,) true camera centre, the truth's units.

    Raises:
        CorruptError: it is not a JSON object with `frames` that hold `file` and a 4 x 4
            `transform_matrix`, camera to world.
    """
    try:
        frames = json.loads(path.read_text("utf-8"))["frames"]
        centers = {}
        for frame in frames:
            pose = np.asarray(frame["transform_matrix"], np.float64)
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise ValueError(f"the pose of {frame['file']} is not 4 x 4 finite numbers")
            centers[PurePath(frame["file"]).stem] = pose[:3, 3]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CorruptError(f"{path}: expected `frames` of true cameras ({error})") from None
    return centers


def world_from_truth(cameras: Sequence[Camera], centers: Mapping[str, F64]) -> F64 | None:
    """(4, 4) similarity that lays the true camera centres on the found ones.

    Least squares (Umeyama 1991), cameras that were found in a wrong place weighted down.

    Returns:
        None where fewer than three cameras are in both, or all stand in one line.
    """
    both = [camera for camera in cameras if camera.name in centers]
    if len(both) < _LEAST:
        return None
    found = np.stack([camera.center for camera in both])
    truth = np.stack([centers[camera.name] for camera in both])
    if np.linalg.matrix_rank(truth - truth.mean(0), tol=1e-6 * np.ptp(truth)) < 2:
        return None
    return robust_similarity(truth, found)


def laid(mesh: TriangleMesh, world: F64) -> TriangleMesh:
    """A mesh moved by a (4, 4) similarity."""
    vertices = mesh.vertices.astype(np.float64) @ world[:3, :3].T + world[:3, 3]
    return TriangleMesh(vertices.astype(np.float32), mesh.faces)
