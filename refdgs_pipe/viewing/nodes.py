"""What stands in the 3D scene: cameras, points, ball, plane, mesh and asset, as viser's nodes."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.camera import Camera
from refdgs_pipe.sfm.frame import z_from_up
from refdgs_pipe.sfm.support import Plane
from refdgs_pipe.viewing.adjusting import Choice
from refdgs_pipe.viewing.contents import PlacedAsset, Scene

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

MOST_POINTS = 100_000  # that are sent to the browser
_TRAINED, _HELD = (60, 110, 200), (220, 140, 40)  # RGB of cameras: used, held out
_BALL, _PLANE, _UP, _MESH = (90, 160, 240), (120, 170, 120), (40, 170, 80), (190, 190, 190)


def wxyz(rotation: F64) -> F64:
    """(4,) the unit quaternion of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat(scalar_first=True))


class Nodes:
    """The nodes of a scene on a viser server.

    Args:
        scene: viser's SceneApi.
        jump: called with a camera whose frustum was clicked, and viser's client.
    """

    def __init__(self, scene: Any, jump: Callable[[Camera, Any], None]) -> None:
        self._scene, self._jump = scene, jump
        self._frusta: dict[str, Any] = {}
        self._nodes: dict[str, Any] = {}
        scene.configure_environment_map("city")

    def place(self, scene: Scene) -> None:
        """Cameras, points, ball, plane and up direction, in place of those that were there."""
        model = scene.model
        self._scene.set_up_direction(tuple(model.up))
        for old in self._frusta.values():
            old.remove()
        self._frusta = {}
        size = frustum_size(model)
        for number, camera in enumerate(model.cameras):
            self._frusta[camera.name] = self._frustum(f"/cameras/{number:05d}", camera, size)
        points, colors = thinned(model)
        if len(points):
            self._nodes["points"] = self._scene.add_point_cloud(
                "/points",
                points,
                colors,
                point_size=0.01 * model.ball.radius,
                point_shape="circle",
                precision="float32",
                point_shading="flat",
            )
        self._add_plane(scene.plane, model)
        self.adjust(Choice.of(model))

    def adjust(self, choice: Choice) -> None:
        """The ball and the arrow that points up."""
        self._nodes["ball"] = self._scene.add_icosphere(
            "/ball",
            choice.radius,
            _BALL,
            subdivisions=3,
            opacity=0.12,
            side="double",
            position=tuple(choice.center),
            cast_shadow=False,
            receive_shadow=False,
        )
        tip = choice.center + 1.25 * choice.radius * choice.up
        self._nodes["up"] = self._scene.add_arrows(
            "/up",
            np.stack([choice.center, tip])[None],
            _UP,
            shaft_radius=0.008 * choice.radius,
            head_radius=0.025 * choice.radius,
            head_length=0.07 * choice.radius,
        )

    def picture(self, name: str, pixels: U8 | None) -> None:
        """Put a photo into the frustum of its camera."""
        if name in self._frusta:
            self._frusta[name].image = pixels

    def mesh(self, mesh: TriangleMesh | None) -> None:
        """Show a mesh, or none."""
        self._drop("mesh")
        if mesh is not None:
            self._nodes["mesh"] = self._scene.add_mesh_simple(
                "/mesh", mesh.vertices, mesh.faces, color=_MESH, side="double"
            )

    def asset(self, asset: PlacedAsset | None) -> None:
        """Show an asset, or none."""
        self._drop("asset")
        if asset is not None:
            self._nodes["asset"] = self._scene.add_glb(
                "/asset", asset.glb, scale=asset.scale, wxyz=tuple(wxyz(asset.world_from_asset))
            )

    def show(self, name: str, is_shown: bool) -> None:
        """Show or hide cameras, points, ball, plane, up, mesh or asset."""
        nodes = self._frusta.values() if name == "cameras" else [self._nodes.get(name)]
        for node in nodes:
            if node is not None and node.visible != is_shown:
                node.visible = is_shown

    def _frustum(self, name: str, camera: Camera, size: float) -> Any:
        pose = camera.world_from_cam
        node = self._scene.add_camera_frustum(
            name,
            fov=2 * float(np.arctan(camera.height / 2 / camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=size,
            thickness=0.02 * size,
            color=_HELD if camera.split == "test" else _TRAINED,
            wxyz=tuple(wxyz(pose[:3, :3])),
            position=tuple(camera.center),
            cast_shadow=False,
            receive_shadow=False,
        )
        node.on_click(lambda event: self._jump(camera, event.client))
        return node

    def _add_plane(self, plane: Plane | None, model: SparseModel) -> None:
        self._drop("plane")
        if plane is None:
            return
        half, center = 1.3 * model.ball.radius, model.ball.center
        foot = center - plane.heights(center[None])[0] * plane.normal
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
        self._nodes["plane"] = self._scene.add_mesh_simple(
            "/plane",
            corners.astype(np.float32),
            np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
            color=_PLANE,
            opacity=0.3,
            side="double",
            wxyz=tuple(wxyz(z_from_up(plane.normal).T)),
            position=tuple(foot),
            cast_shadow=False,
            receive_shadow=False,
        )

    def _drop(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()


def frustum_size(model: SparseModel) -> float:
    """How deep a frustum is drawn, world units: many cameras must not hide each other."""
    away = [float(np.linalg.norm(c.center - model.ball.center)) for c in model.cameras]
    apart = 2 * np.pi / max(len(away), 1)  # on a circle, seen from the middle
    return float(np.median(away) * np.clip(0.4 * apart, 0.04, 0.1))


def thinned(model: SparseModel) -> tuple[F64, U8]:
    """The points and their colours, not more than are sent."""
    every = max(1, -(-len(model.points) // MOST_POINTS))
    return model.points[::every], model.point_colors[::every]


def stand_before(scene: Scene, *, is_close: bool) -> tuple[F64, F64]:
    """Where to look from at first, and at what: near the middle camera, outside of all cameras.

    Args:
        is_close: before the cameras instead, which would hide the object.
    """
    model = scene.model
    center, up = model.ball.center, model.up
    towards = np.stack([c.center - center for c in model.cameras])
    away = np.linalg.norm(towards, axis=1)
    level = towards - (towards @ up)[:, None] * up
    mean = level[int(np.argmin(np.abs(away - np.median(away))))]
    if np.linalg.norm(mean) < 1e-6 * model.ball.radius:
        mean = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead = mean / np.linalg.norm(mean)
    distance = 0.7 * float(np.median(away)) if is_close else 1.3 * float(away.max())
    distance = max(distance, (2.0 if is_close else 3.0) * model.ball.radius)
    return center + distance * (0.85 * ahead + 0.5 * up), center
