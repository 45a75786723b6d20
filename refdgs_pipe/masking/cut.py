"""The least outline that fits the evidence: a convex cut with sub-pixel edges."""

import numpy as np

from refdgs_pipe.masking.shots import F32

STEPS = 100
STEP = 0.35  # of the primal-dual method; below 1 / sqrt(8)
FLOOR = 0.1  # least price of an outline, where the photo has an edge


def cut(evidence: F32, rgb: F32, *, weight: float) -> F32:
    """(H, W) how much of each pixel is the object.

    Minimises the outline's length, cheap along the photo's edges (Boykov and Jolly 2001), plus
    the evidence over the object, as a convex problem (Chan, Esedoglu and Nikolova 2006) by the
    primal-dual method of Chambolle and Pock (2011).

    Args:
        evidence: (H, W) log odds of background.
        rgb: (H, W, 3) sRGB in [0, 1].
        weight: of the evidence against the outline, per pixel.
    """
    data = np.asarray(evidence * np.float32(weight), np.float32)
    across = np.square(np.diff(rgb, axis=1)).sum(-1)
    down = np.square(np.diff(rgb, axis=0)).sum(-1)
    sharp = 1 / max(float(across.mean() + down.mean()), 1e-6)
    right, below = (FLOOR + (1 - FLOOR) * np.exp(-sharp * change) for change in (across, down))
    inside = (data < 0).astype(np.float32)
    ahead = inside.copy()
    flow_x, flow_y = np.zeros_like(across), np.zeros_like(down)
    for _ in range(STEPS):
        flow_x += STEP * (ahead[:, 1:] - ahead[:, :-1])
        flow_y += STEP * (ahead[1:] - ahead[:-1])
        np.clip(flow_x, -right, right, out=flow_x)
        np.clip(flow_y, -below, below, out=flow_y)
        out = -data
        out[:, :-1] += flow_x
        out[:, 1:] -= flow_x
        out[:-1] += flow_y
        out[1:] -= flow_y
        new = np.clip(inside + STEP * out, 0, 1)
        ahead, inside = 2 * new - inside, new
    return inside
