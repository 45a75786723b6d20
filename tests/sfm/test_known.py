"""Features add points to poses that came with the capture."""

import numpy as np

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.sfm.known import FEW_POINTS, doubt_of_points


def poses(seen: int) -> Poses:
    tracks = {f"{name}.png": np.arange(seen) for name in "abc"}
    places = dict.fromkeys(tracks, np.eye(4))
    colors = np.zeros((seen, 3), np.uint8)
    return Poses(
        places, dict.fromkeys(tracks, 0), (), np.zeros((seen, 3)), colors, tracks, 0, "given"
    )


def test_few_points_that_fit_known_poses_are_said() -> None:
    assert doubt_of_points(poses(FEW_POINTS)) is None
    said = doubt_of_points(poses(FEW_POINTS - 1))
    assert said is not None and "poses may be wrong" in said
