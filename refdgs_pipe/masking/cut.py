"""The least outline that fits the evidence: a convex cut with sub-pixel edges."""

import numpy as np
import torch

from refdgs_pipe.masking.shots import F32

STEPS = 150
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
    data = torch.from_numpy(np.asarray(evidence * np.float32(weight), np.float32))
    image = torch.from_numpy(np.ascontiguousarray(rgb))
    across = (image[:, 1:] - image[:, :-1]).square().sum(-1)
    down = (image[1:] - image[:-1]).square().sum(-1)
    sharp = 1 / (across.mean() + down.mean()).clamp(min=1e-6)
    price = torch.zeros(2, *data.shape)
    price[0, :, :-1] = FLOOR + (1 - FLOOR) * torch.exp(-sharp * across)
    price[1, :-1] = FLOOR + (1 - FLOOR) * torch.exp(-sharp * down)
    inside = (data < 0).float()
    ahead, flow = inside.clone(), torch.zeros_like(price)
    for _ in range(STEPS):
        flow[0, :, :-1] += STEP * (ahead[:, 1:] - ahead[:, :-1])
        flow[1, :-1] += STEP * (ahead[1:] - ahead[:-1])
        flow = torch.maximum(torch.minimum(flow, price), -price)
        out = flow[0] + flow[1]
        out[:, 1:] -= flow[0, :, :-1]
        out[1:] -= flow[1, :-1]
        new = (inside + STEP * (out - data)).clamp(0, 1)
        ahead, inside = 2 * new - inside, new
    return np.asarray(inside.numpy(), np.float32)
