"""The least outline that fits the evidence: a convex cut with sub-pixel edges."""

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label

from refdgs_pipe.ground.shots import F32, Bools

STEPS = 100
STEP = 0.35  # of the primal-dual method; below 1 / sqrt(8)
FLOOR = 0.1  # least price of an outline, where the photo has an edge
EDGE = 0.5  # of the median change of colour along the outline: an edge
RIMMED = 0.6  # share of a hole's rim that has to be an edge
SHARED = 0.5  # share of a hole that the solid's silhouette covers, if the hole may be false


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


def without_false_holes(mask: F32, rgb: F32, outline: Bools | None = None) -> F32:
    """The mask with the holes filled that no edge of the photo goes round.

    Where an object looks like what is behind it, some of its inside can be taken for that. A true
    hole has an edge of the object all round, or the solid that other photos agree on has it too.

    Args:
        mask: (H, W) in [0, 1]; rgb: (H, W, 3) sRGB in [0, 1].
        outline: (H, W) the silhouette of that solid; None where it is not known.
    """
    solid = mask > 0.5
    holes, count = label(~solid)
    if count < 2 or not solid.any():
        return mask
    change = np.zeros(solid.shape, np.float32)
    for channel in cv2.split(cv2.GaussianBlur(rgb, (0, 0), 1.0)):
        dx, dy = (cv2.Sobel(channel, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
        change = np.maximum(change, np.hypot(dx, dy))
    change = cv2.dilate(change, np.ones((3, 3), np.uint8))
    beyond = np.unique(np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]]))
    outer = np.isin(holes, beyond) & ~solid
    edge = binary_dilation(outer) & solid
    if not edge.any():
        return mask
    least = EDGE * float(np.median(change[edge]))
    filled = mask.copy()
    for number, box in enumerate(find_objects(holes), 1):
        if number in beyond:
            continue
        part = tuple(slice(side.start - 1, side.stop + 1) for side in box)
        hole = holes[part] == number
        if outline is not None and outline[part][hole].mean() < SHARED:
            continue
        rim = binary_dilation(hole) & solid[part]
        if (change[part][rim] >= least).mean() < RIMMED:
            filled[part][hole] = 1.0
    return filled


def signed_distance(mask: Bools) -> F32:
    """(H, W) pixels to the mask's edge, positive inside."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(inside - outside, np.float32)


def well_inside(mask: Bools, pixels: float) -> Bools:
    """(H, W) the mask's pixels that are farther than that from its edge, and than one pixel."""
    return np.asarray(signed_distance(mask) > max(1.0, pixels))
