"""Small facts about space that several packages need."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera
from refdgs_pipe.ray_casting import Solid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

ONE_SIDED_DEG = 150.0  # of a stretch round the object without a photo
_ROUNDS = 20
_FAR = 4.0  # median distances from the middle: what lies farther counts less


def y_up_from_z_up(up: F64) -> F64:
    """(3, 3) rotation to the frame of glTF and USD: +Y up.

    `up` is the world's unit up vector. For +z it is the quarter turn about x that every tool
    uses: world x stays x, world -y becomes +z (the front).
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return np.asarray(quarter @ _shortest_rotation(up, np.array([0.0, 0.0, 1.0])))


def _shortest_rotation(source: F64, target: F64) -> F64:
    """(3, 3) the smallest rotation that takes one unit vector to another (Rodrigues)."""
    axis, cosine = np.cross(source, target), float(source @ target)
    if cosine < -1 + 1e-12:  # opposite: half a turn about any perpendicular axis
        axis = np.eye(3)[np.abs(source).argmin()]
        axis = axis - source * (source @ axis)
        axis /= np.linalg.norm(axis)
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


def widest_stretch(azimuths: list[float]) -> tuple[float, float]:
    """Start and end, end > start, of the widest part of a circle without any of the azimuths.

    Args:
        azimuths: degrees from -180 to 180, at least one.
    """
    order = sorted(azimuths)
    stretches = [(a, b) for a, b in zip(order, [*order[1:], order[0] + 360.0], strict=True)]
    return max(stretches, key=lambda s: s[1] - s[0])


def one_sided(cameras: tuple[Camera, ...], middle: F64, up: F64) -> bool:
    """Whether all photos of an object were taken from about one side.

    Args:
        middle: (3,) of the object; up: (3,) unit.
    """
    away = np.stack([camera.center for camera in cameras]) - middle
    x, _, z = y_up_from_z_up(up) @ away.T
    start, end = widest_stretch([float(a) for a in np.degrees(np.arctan2(x, z))])
    return end - start >= ONE_SIDED_DEG


def through_plane(one: Camera, other: Camera, inverse: float) -> F64:
    """(3, 3) from a photo's pixels to another's, by a plane at a depth of 1 / `inverse`.

    Pixel centres are at +0.5; 0 is a plane at infinity.
    """
    turn = other.cam_from_world[:3, :3] @ one.cam_from_world[:3, :3].T
    shift = other.cam_from_world[:3, 3] - turn @ one.cam_from_world[:3, 3]
    moved = turn + np.outer(shift, [0, 0, inverse])
    return np.asarray(other.K @ moved @ np.linalg.inv(one.K))


def homography_warp(image: F32, to: F64, width: int, height: int, outside: float) -> F32:
    """(height, width, ...) the image seen through a homography.

    Args:
        to: (3, 3) from the result's coordinates to those of the image, pixel centres at +0.5.
        outside: what stands where the image has nothing.
    """
    import cv2

    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    matrix = np.linalg.inv(shift) @ to @ shift
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    out = cv2.warpPerspective(
        image, matrix, (width, height), flags=flags, borderValue=(outside,) * 4
    )
    return np.asarray(out, np.float32)


def without_jumps(depth: F32, normal: F32, camera: Camera, slack: float) -> NDArray[np.bool_]:
    """(H, W) whether a pixel's 3 x 3 neighbourhood is one surface.

    It is when the depths (0: none) differ by at most twice what the pixel's own normal explains,
    plus `slack` in world units. Pixels without a surface are not smooth; as neighbours they do
    not count.
    """
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    far = np.asarray(cv2.dilate(depth, kernel))
    near = np.asarray(cv2.erode(np.where(depth > 0, depth, np.float32(1e30)), kernel))
    rays = camera.pixel_rays().astype(np.float32)
    world = rays @ camera.world_from_cam[:3, :3].T.astype(np.float32)
    cosine = -(world * normal).sum(-1) / np.linalg.norm(world, axis=-1)
    slope = np.sqrt(np.maximum(1 / np.maximum(cosine, 0.05) ** 2 - 1, 0))
    explained = 2 * 2**0.5 * depth / float(camera.K[0, 0]) * slope
    return np.asarray((depth > 0) & (far - near < 2 * explained + slack))


def robust_similarity(source: F64, target: F64) -> F64:
    """(4, 4) similarity that lays points (n, 3) on their partners (n, 3).

    Least squares (Umeyama 1991), pairs that do not fit weighted down in 20 rounds. A source point
    far from the others would turn all of them, however small its weight, so its distance counts
    too. The points are not all in one line.
    """
    away = np.linalg.norm(source - np.median(source, axis=0), axis=1)
    near = np.minimum(1.0, (_FAR * np.median(away) + 1e-12) / np.maximum(away, 1e-12)) ** 2
    weights = near
    world = np.eye(4)
    for _ in range(_ROUNDS):
        world = _similarity(source, target, weights)
        misses = np.linalg.norm(source @ world[:3, :3].T + world[:3, 3] - target, axis=1)
        weights = near / np.maximum(misses, np.median(misses) + 1e-12)
    return world


def _similarity(source: F64, target: F64, weights: F64) -> F64:
    """(4, 4) that takes (N, 3) source to target, weighted least squares."""
    w = (weights / weights.sum())[:, None]
    a, b = source - (w * source).sum(0), target - (w * target).sum(0)
    u, sizes, vt = np.linalg.svd((w * b).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((sizes * signs).sum() / (w * a * a).sum())
    out = np.eye(4)
    out[:3, :3] = scale * rotation
    out[:3, 3] = (w * target).sum(0) - scale * rotation @ (w * source).sum(0)
    return out


def hit_depth(solid: Solid, camera: Camera) -> F32:
    """(H, W) camera z, world units, where the rays through the pixels' centres meet; else 0."""
    rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
    hits = solid.first(camera.center.astype(np.float32), rays.astype(np.float32))
    depth = np.zeros(len(rays), np.float32)
    depth[hits.rays] = hits.distance
    return depth.reshape(camera.height, camera.width)


def outline_distance(covered: NDArray[np.bool_]) -> F32:
    """(H, W) pixels from each pixel's centre to the outline of what is covered, negative outside.

    Zero lies between the pixels on both sides.
    """
    import cv2

    solid = covered.astype(np.uint8)
    within = cv2.distanceTransform(solid, cv2.DIST_L2, 5)
    beyond = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 5)
    return np.asarray(np.where(covered, within - 0.5, 0.5 - beyond), np.float32)


def spread_over(
    vertices: F64, faces: NDArray[np.int32], count: int, seed: int
) -> tuple[NDArray[np.int64], F64]:
    """Places spread evenly over a mesh's area; the same for the same mesh and seed.

    Returns:
        (count,) their faces and (count, 3) weights of the faces' corners; none if the mesh has no
        area.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = areas.sum()
    if not total > 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    chance = np.random.default_rng(seed)
    places = (np.arange(count) + chance.random()) / count  # evenly along the heap of triangles
    face = np.searchsorted(np.cumsum(areas) / total, places).clip(max=len(areas) - 1)
    u, v = chance.random((2, count))
    root = np.sqrt(u)  # Osada et al. 2002, section 3.1
    return face, np.stack([1 - root, root * (1 - v), root * v], axis=1)
