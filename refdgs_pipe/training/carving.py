"""Hollows that silhouettes cannot show, opened where the photos agree on what lies behind."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_closing
from torch import Tensor
from torch.nn import functional

from refdgs_pipe.camera import F64, Camera

Bool = NDArray[np.bool_]

VIEWS = 64  # photos used at most
FOOTPRINT = 1.2  # pixels that a cell covers in the pictures that are compared
SLACK = 1.5  # cells that a visible cell's centre may lie behind the nearest one
TOLERANCE = 0.012  # of sRGB, on top of the picture's own variation around the pixel
FEWEST = 5  # photos that must see a cell to judge it
AGREEING = 0.6  # share of the photos that see a cell that make it a surface by agreeing
ROUNDS = 6  # of search for surfaces behind what is no surface
MATCH = 1.5  # tolerances that a photo may differ from the surface it sees through an empty cell
SUPPORT = 0.65  # share of the photos through an empty cell that must match what lies behind
CLEAR = 0.99  # mask of pixels that show the object alone


def boundary(cells: Bool) -> Bool:
    """Cells with one of their six neighbours outside."""
    padded = np.pad(cells, 1)
    beside = [np.roll(padded, s, a)[1:-1, 1:-1, 1:-1] for a in range(3) for s in (1, -1)]
    return np.asarray(cells & ~np.logical_and.reduce(beside))


def empty_cells(
    hull: Bool,
    ticks: tuple[F64, F64, F64],
    cameras: list[Camera],
    pictures: list[Tensor],
    masks: list[Tensor],
    ground: Bool | None = None,
) -> Bool:
    """(nx, ny, nz) cells of the hull through which the photos see a surface that they agree on.

    After space carving (Kutulakos and Seitz 2000), turned round to be safe with mirrors: there, a
    cell is removed when photos disagree on its colour, and mirrors, on which they never agree,
    vanish. Here a cell counts as surface when most photos that see it agree, and as empty when
    most photos that look through it match the surface behind it. Cells with no evidence either
    way, as in a mirror or in its shadow, are left alone.

    Args:
        hull: (nx, ny, nz) the visual hull.
        ticks: world coordinates of the cells' centres along x, y and z, equally spaced.
        pictures: (3, H, W) float sRGB in [0, 1] for each camera, straight.
        masks: (H, W) float in [0, 1] for each camera.
        ground: (nx, ny, nz) cells on the ground and below. Within the masks no photo sees the
            ground: what photos agree on there is its mirror image in a wall.
    """
    grid = _Grid(hull, ticks)
    count = min(len(cameras), VIEWS)
    chosen = np.linspace(0, len(cameras) - 1, count).round().astype(int)
    views = [_View(cameras[i], pictures[i], masks[i], grid) for i in chosen]
    cells = torch.nonzero(torch.from_numpy(hull).flatten()).flatten()
    if len(views) < FEWEST or not len(cells):
        return np.zeros_like(hull)
    above = cells if ground is None else cells[~torch.from_numpy(ground.ravel())[cells]]
    surface, color = _surfaces(views, grid, hull, above)
    unknown = cells[~surface[cells]]
    through, matched = torch.zeros(2, hull.size)
    points = grid.points(unknown)
    seen = torch.nonzero(surface).flatten()
    for view in views:
        depth, owner = view.nearest(grid, seen, closed=True)
        difference = (view.color - color[owner.clamp(min=0)]).abs().amax(-1)
        known = (owner >= 0).float()
        match = known * (difference <= MATCH * view.tolerance)
        both = torch.stack([known, match]).reshape(1, 2, view.height, view.width)
        both = functional.avg_pool2d(both, 3, 1, 1)  # gaps between cells take their neighbours'
        share = (both[0, 1] / both[0, 0].clamp(min=1e-6)).flatten()
        pixel, z, inside = view.project(points)
        passes = inside & (z < depth[pixel] - SLACK * grid.size) & view.clear[pixel]
        through[unknown] += passes
        matched[unknown] += passes * share[pixel]
    evidence = torch.stack([through, matched]).reshape(1, 2, *hull.shape)
    through, matched = functional.avg_pool3d(evidence, 3, 1, 1).reshape(2, -1)[:, unknown]
    empty = torch.zeros(hull.size, dtype=torch.bool)
    empty[unknown] = (through >= FEWEST) & (matched >= SUPPORT * through)
    return empty.reshape(hull.shape).numpy()


def needed_by_masks(
    hull: Bool,
    left: Bool,
    ticks: tuple[F64, F64, F64],
    cameras: list[Camera],
    masks: list[Tensor],
) -> Bool:
    """(nx, ny, nz) cells of the hull without which `left` would not cover the masks.

    Args:
        left: (nx, ny, nz) what is kept of the hull.
        ticks, masks: as in `empty_cells`.
    """
    grid, needed = _Grid(hull, ticks), np.zeros(hull.size, bool)
    kept, gone = (torch.from_numpy(np.flatnonzero(c)) for c in (left, hull & ~left))
    nothing = torch.zeros(3, 1, 1)
    for camera, mask in zip(cameras, masks, strict=True):
        view = _View(camera, nothing.expand(3, *mask.shape), mask, grid, footprint=1.0)
        pixel, _, inside = view.project(grid.points(kept))
        covered = np.zeros(view.height * view.width, bool)
        covered[pixel[inside].numpy()] = True
        padded = np.pad(covered.reshape(view.height, view.width), 3)
        covered = binary_closing(padded, np.ones((3, 3)))[3:-3, 3:-3].ravel()
        missing = (view.mask.numpy() > 0.5) & ~covered
        pixel, _, inside = view.project(grid.points(gone))
        needed[gone.numpy()[missing[pixel.numpy()] & inside.numpy()]] = True
    return needed.reshape(hull.shape)


class _Grid:
    """Cells by their flat index."""

    def __init__(self, cells: Bool, ticks: tuple[F64, F64, F64]) -> None:
        self.shape = cells.shape
        self.ticks = [torch.from_numpy(np.asarray(t, np.float32)) for t in ticks]
        self.size = float(ticks[0][1] - ticks[0][0])

    def points(self, index: Tensor) -> Tensor:
        """(N, 3) centres."""
        _, ny, nz = self.shape
        i, j, k = index // (ny * nz), index // nz % ny, index % nz
        return torch.stack([self.ticks[0][i], self.ticks[1][j], self.ticks[2][k]], -1)


class _View:
    """One photo, shrunk until a cell covers `footprint` pixels.

    mask (H W,), color (H W, 3), tolerance (H W,): how far a photo of the same spot may differ;
    clear (H W,).
    """

    def __init__(
        self,
        camera: Camera,
        picture: Tensor,
        mask: Tensor,
        grid: _Grid,
        footprint: float = FOOTPRINT,
    ) -> None:
        center = np.array([float(t.mean()) for t in grid.ticks])
        distance = float(np.linalg.norm(camera.center - center))
        scale = min(1.0, footprint * distance / (grid.size * float(camera.K[0, 0])))
        camera = camera.resized(
            max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
        )
        self.width, self.height = camera.width, camera.height
        size = (self.height, self.width)
        small = functional.interpolate(
            torch.cat([picture, mask[None]])[None], size, mode="area"
        ).squeeze(0)
        self.mask = small[3].flatten()
        self.clear = self.mask > CLEAR
        self.color = small[:3].permute(1, 2, 0).reshape(-1, 3).contiguous()
        moments = torch.cat([small[:3], small[:3] ** 2])[None]
        moments = functional.avg_pool2d(
            functional.pad(moments, (1, 1, 1, 1), mode="replicate"), 3, 1
        ).squeeze(0)
        spread = (moments[3:] - moments[:3] ** 2).clamp(min=0).sqrt().amax(0)
        self.tolerance = (TOLERANCE + spread).flatten()
        self._pose = torch.tensor(camera.cam_from_world, dtype=torch.float32)
        self._K = [float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pixel (N,), depth (N,), and whether inside the picture (N,)."""
        fx, fy, cx, cy = self._K
        x, y, z = (points @ self._pose[:3, :3].T + self._pose[:3, 3]).unbind(-1)
        col, row = torch.floor(fx * x / z + cx), torch.floor(fy * y / z + cy)
        inside = (z > 0) & (col >= 0) & (col < self.width) & (row >= 0) & (row < self.height)
        return torch.where(inside, row * self.width + col, 0).long(), z, inside

    def nearest(self, grid: _Grid, cells: Tensor, *, closed: bool) -> tuple[Tensor, Tensor]:
        """Depth (H W,) and index (H W,) of the nearest cell; inf and -1 where there is none.

        Args:
            closed: pixels between cells are as deep as those.
        """
        pixel, z, inside = self.project(grid.points(cells))
        pixel, z, cells = pixel[inside], z[inside], cells[inside]
        depth = torch.full((self.height * self.width,), torch.inf)
        depth.scatter_reduce_(0, pixel, z, "amin")
        owner = torch.full(depth.shape, -1)
        front = z <= depth[pixel]
        owner.scatter_reduce_(0, pixel[front], cells[front], "amax")
        if closed:
            image = depth.reshape(1, 1, self.height, self.width)
            grown = functional.max_pool2d(-image, 3, 1, 1)
            shut = functional.max_pool2d(-grown, 3, 1, 1).flatten()
            depth = torch.where(owner < 0, shut, depth)
        return depth, owner


def _surfaces(views: list[_View], grid: _Grid, hull: Bool, cells: Tensor) -> tuple[Tensor, Tensor]:
    """(cells,) bool and colour (cells, 3): first on the hull, then behind what is no surface."""
    surface, color = torch.zeros(hull.size, dtype=torch.bool), torch.zeros(hull.size, 3)
    asked = hidden_by = torch.from_numpy(np.flatnonzero(boundary(hull)))
    for turn in range(ROUNDS):
        median, agree = _opinions(views, grid, asked, hidden_by, closed=turn > 0)
        new = asked[agree]
        surface[new], color[new] = True, median[agree]
        hidden_by = torch.nonzero(surface).flatten()
        asked = cells[~surface[cells]]
        if not len(asked) or (turn > 0 and len(new) < 0.01 * len(hidden_by)):
            break
    return surface, color


def _opinions(
    views: list[_View], grid: _Grid, cells: Tensor, hidden_by: Tensor, *, closed: bool
) -> tuple[Tensor, Tensor]:
    """Median colour (N, 3) of cells (N,) and whether the photos that see them agree on it."""
    points = grid.points(cells)
    colors = torch.full((len(views), len(cells), 3), torch.nan)
    limits = torch.zeros(len(views), len(cells))
    for v, view in enumerate(views):
        depth, _ = view.nearest(grid, hidden_by, closed=closed)
        pixel, z, inside = view.project(points)
        front = inside & view.clear[pixel] & (z <= depth[pixel] + SLACK * grid.size)
        seen = torch.nonzero(front).flatten()
        colors[v, seen] = view.color[pixel[seen]]
        limits[v, seen] = view.tolerance[pixel[seen]]
    median = colors.nanmedian(0).values
    count = (~colors[..., 0].isnan()).sum(0)
    agreeing = ((colors - median).abs().amax(-1) <= limits).sum(0)  # false where not seen
    return median.nan_to_num(), (count >= FEWEST) & (agreeing >= AGREEING * count)
