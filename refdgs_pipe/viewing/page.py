"""One page for a workspace: looks now and then, shows what is new, draws the field on demand."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import Camera
from refdgs_pipe.viewing.adjusting import Choice
from refdgs_pipe.viewing.contents import Contents, Scene
from refdgs_pipe.viewing.drawing import camera_at, drawn, size_for
from refdgs_pipe.viewing.effort import Effort
from refdgs_pipe.viewing.nodes import Nodes, stand_before, wxyz
from refdgs_pipe.viewing.panel import LAYERS, Panel, Told
from refdgs_pipe.viewing.watching import Seen, Watch

LOOK_S, LOOK_RUNNING_S = 2.0, 4.0  # between two looks at the workspace
REST_S = 0.3  # a camera that stood still so long is at rest
_PAUSES = {"alone": 0.5, "waiting": 0.5, "still": 0.1, "busy": 0.01}  # seconds
_MOVING, _RESTING = 320, 800  # px of the longer side of what is drawn
_RESTING_RUNNING = 560  # while a run needs the machine
_DEEPEST = 160.0  # world units: viser's depth of a picture ends at 167


@dataclass
class _Client:
    """A browser, and what it was sent.

    Args:
        pose: of its camera when last looked at; moved: when that changed.
        has: what the picture behind its scene was drawn from; None if there is none.
    """

    pose: tuple[float, ...] = ()
    moved: float = 0.0
    has: tuple[Any, ...] | None = None


class Page:
    """The view of one workspace on a server.

    Args:
        server: viser's ViserServer.
        watch: looks at the workspace.
        effort: says whether work may be done.
        stages, run, remember: see `Panel`.
    """

    def __init__(
        self,
        server: Any,
        watch: Watch,
        effort: Effort,
        *,
        stages: Mapping[str, str],
        run: str,
        remember: Callable[[list[str]], str],
    ) -> None:
        self.server, self.watch, self.effort = server, watch, effort
        self.contents = Contents()
        self.nodes = Nodes(server.scene, _jump)
        self.panel = Panel(
            server.gui, stages=stages, run=run, remember=remember, changed=self._choose
        )
        self._clients: dict[int, _Client] = {}
        self._shown: dict[str, Any] = {}  # piece -> the object that is shown
        self._photos: dict[str, Any] = {}  # camera -> its picture, small; None if it has none
        self._of: tuple[Any, bool] = (None, False)  # views and masks that these are made of
        self._has_object = False  # whether any of the object was shown
        self._looked = -LOOK_S
        self._chosen = True  # whether the user chose anything since

    def step(self) -> float:
        """Do what there is to do. Return for how many seconds there is nothing else."""
        clients = self.server.get_clients()
        self._clients = {n: self._clients.get(n, _Client()) for n in clients}
        if not clients:
            return _PAUSES["alone"]
        now = time.monotonic()
        if now - self._looked >= (LOOK_RUNNING_S if self.seen.is_running else LOOK_S):
            self._looked = now
            self.contents.adopt(self.watch.look())
            self._tell()
        if self._chosen:
            self._chosen = False
            self._arrange()
            self._tell()
        running = self.seen.is_running or self.seen.run_s is not None
        moving = [self._note_moves(n, client, now) for n, client in clients.items()]
        if not self.effort.allows(is_running=running, run_s=self.seen.run_s):
            self._hide_old_pictures(clients, moving)
            return _PAUSES["waiting"]
        did = self._update() or self._draw(clients, now, is_running=running) or self._add_photo()
        return _PAUSES["busy" if did else "still"]

    @property
    def seen(self) -> Seen:
        """The workspace as it was last looked at."""
        return self.contents.seen

    def _update(self) -> bool:
        """Show one piece that is new, of those that are wanted. Return whether there was one."""
        makers: dict[str, Callable[[], Any]] = {"scene": self.contents.scene}
        makers |= {"mesh": self.contents.mesh, "asset": self.contents.asset}
        makers |= {"field": self.contents.field}
        for name in ("scene", self._wanted):
            piece = makers[name]() if name in makers else None
            if piece is self._shown.get(name):
                continue
            is_first = self._shown.get(name) is None
            self._shown[name] = piece
            if name == "scene" and piece is not None:
                self._place(piece, is_first=is_first)
            elif name == "mesh":
                self.nodes.mesh(None if piece is None else piece[0])
            elif name == "asset":
                self.nodes.asset(piece)
            if name != "scene" and not self._has_object and piece is not None:
                self._has_object = True
                for layer in ("points", "ball"):  # they would hide the object
                    self.panel.layers[layer].value = False
            self._arrange()
            self._tell()
            return True
        return False

    def _place(self, scene: Scene, *, is_first: bool) -> None:
        """Put up the cameras; the first time, stand before the object."""
        self.nodes.place(scene)
        self.panel.place(scene, self._adjust, self.server.scene)
        for name, pixels in self._photos.items():
            self.nodes.picture(name, pixels)
        if not is_first:
            return
        eye, target = stand_before(scene, is_close=bool(self.contents.newest))
        start = self.server.initial_camera
        start.up, start.position = tuple(scene.model.up), tuple(eye)
        start.look_at = tuple(target)
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = tuple(scene.model.up)
                client.camera.position, client.camera.look_at = tuple(eye), tuple(target)

    def _adjust(self, choice: Choice) -> None:
        self.nodes.adjust(choice)
        self.panel.layers["ball"].value = True

    def _choose(self) -> None:
        """The user chose something else: on viser's thread, so only noted."""
        self._chosen = True

    @property
    def _wanted(self) -> str:
        """What of the object is to be shown: "field", "mesh", "asset", "none" or ""."""
        chosen = str(self.panel.object.value)
        return self.contents.newest if chosen == "newest" else chosen

    @property
    def _object(self) -> str:
        """What of that is there: "field", "mesh", "asset" or ""."""
        return self._wanted if self._shown.get(self._wanted) is not None else ""

    def _arrange(self) -> None:
        """Show and hide what the user chose."""
        for name in LAYERS:
            self.nodes.show(name, bool(self.panel.layers[name].value))
        self.nodes.show("up", bool(self.panel.layers["ball"].value))
        for name in ("mesh", "asset"):
            self.nodes.show(name, self._object == name)

    def _tell(self) -> None:
        self.panel.tell(self.seen, Told(self.contents.troubles, self._words()))

    def _words(self) -> str:
        """What of the object is shown."""
        shown = self._object
        if shown == "field":
            is_drawn = any(client.has is not None for client in self._clients.values())
            waits = "" if is_drawn else "; not drawn yet, the run comes first"
            return f"field, {self._shown['field'].about}{waits}"
        if shown == "mesh":
            return f"mesh of {self._shown['mesh'][1]}"
        return shown and "asset, in a light of the view's own"

    def _note_moves(self, number: int, client: Any, now: float) -> bool:
        """Whether a browser's camera moved since the last step."""
        camera, own = client.camera, self._clients[number]
        if not camera.update_timestamp:
            return False
        pose = (*camera.position, *camera.wxyz, camera.fov, camera.aspect)
        if pose == own.pose:
            return False
        own.pose, own.moved = pose, now
        return True

    def _hide_old_pictures(self, clients: Mapping[int, Any], moving: list[bool]) -> None:
        """Rather no picture than that of another place, while none can be drawn."""
        for (number, client), has_moved in zip(clients.items(), moving, strict=True):
            own = self._clients[number]
            if has_moved and own.has is not None:
                own.has = None
                client.scene.set_background_image(None)

    def _draw(self, clients: Mapping[int, Any], now: float, *, is_running: bool) -> bool:
        """Draw the field for one browser whose picture is old. Return whether one was drawn."""
        shown = self._shown.get("field") if self._object == "field" else None
        for number, client in clients.items():
            own = self._clients[number]
            if shown is None:
                if own.has is not None:
                    own.has = None
                    client.scene.set_background_image(None)
                continue
            if not own.pose:
                continue
            at_rest = now - own.moved >= REST_S
            resting = _RESTING_RUNNING if is_running else _RESTING
            longest = resting if at_rest else _MOVING
            wanted = (own.pose, shown, self.panel.kind.value)
            if own.has is not None and own.has[:3] == wanted and own.has[3] >= longest:
                continue
            self._send(client, shown.field, own.pose, longest)
            own.has = (*wanted, longest)
            return True
        return False

    def _send(self, client: Any, field: SurfelField, pose: tuple[float, ...], longest: int) -> None:
        """Draw the field as a browser sees it, behind what stands in its scene."""
        width, height = size_for(pose[8], longest)
        camera = camera_at(
            np.array(pose[:3]), np.array(pose[3:7]), fov=pose[7], width=width, height=height
        )
        made = drawn(field, camera, self.panel.kind.value)
        depth = None
        there = made.depth[np.isfinite(made.depth)]
        if len(there) and float(there.max()) < _DEEPEST:
            depth = np.where(np.isfinite(made.depth), made.depth, _DEEPEST)
        client.scene.set_background_image(made.pixels, format="jpeg", jpeg_quality=85, depth=depth)

    def _add_photo(self) -> bool:
        """Put the next photo into its camera. Return whether there was one."""
        scene, views = self._shown.get("scene"), self.contents.views()
        if scene is None or views is None:
            return False
        masked = bool(self.panel.masks.value)
        if self._of[0] is not views or self._of[1] != masked:
            self._of, self._photos = (views, masked), {}
        left = (c for c in spread_out(scene.model.cameras) if c.name not in self._photos)
        camera = next(left, None)
        if camera is None:
            return False
        pixels = self.contents.thumbnail(camera, masked=masked)
        self._photos[camera.name] = pixels
        self.nodes.picture(camera.name, pixels)
        return True


def spread_out(cameras: tuple[Camera, ...]) -> list[Camera]:
    """The cameras, first some from all over their order, then those between."""
    order: list[int] = []
    step = 1
    while step < len(cameras):
        step *= 2
    while step:
        order += [i for i in range(0, len(cameras), step) if i not in order]
        step //= 2
    return [cameras[i] for i in order]


def _jump(camera: Camera, client: Any) -> None:
    """Let a browser look through a camera."""
    if client is not None:
        pose = camera.world_from_cam
        with client.atomic():
            client.camera.position = tuple(camera.center)
            client.camera.wxyz = tuple(wxyz(pose[:3, :3]))
            client.camera.fov = 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1]))
