"""The artifacts of a workspace as things to show: each read once, a damaged one as a sentence."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import CleanMesh, Mesh, RawMesh, TriangleMesh
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import CorruptError, RefdgsError
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.pipeline.store import load
from refdgs_pipe.sfm.support import Plane, support_plane
from refdgs_pipe.viewing.watching import Found, Seen

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
T = TypeVar("T")
K = TypeVar("K", bound=Artifact)
Marks: TypeAlias = tuple[Any, ...]

THUMBNAIL = 160  # px of the longer side
GLB = "asset.glb"
_MESHES: dict[str, type[TriangleMesh]] = {"extract": RawMesh, "clean": CleanMesh, "fit": Mesh}
MOST_FACES = 400_000  # of a mesh that is sent to the browser
_MOST_BYTES = 200_000_000  # of an asset


@dataclass(frozen=True, eq=False)
class Scene:
    """The cameras and what is around the object.

    Args:
        model: cameras at their newest places, points, ball and up axis, world units.
        plane: that the object stands on, if the points show one.
        set_up: the `gate.up` that the model was made with; None if it was found.
    """

    model: SparseModel
    plane: Plane | None
    set_up: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False)
class PlacedAsset:
    """A GLB, and how it lies in the world.

    Args:
        world_from_asset: (3, 3) rotation; scale: world units of a metre.
    """

    glb: bytes
    world_from_asset: F64
    scale: float


@dataclass(frozen=True, eq=False)
class ShownField:
    """A field to be drawn, and what it is, in words."""

    field: SurfelField
    about: str


class Contents:
    """What there is to show of a workspace. `adopt` what was seen, then ask for pieces.

    A piece is None while it is not there, and if it cannot be read: then `troubles` says why. A
    piece is the same object until what it is made of is replaced.
    """

    def __init__(self) -> None:
        self.seen = Seen()
        self.problems: dict[str, str] = {}  # piece -> sentence
        self._pieces: dict[str, tuple[Marks, Any]] = {}

    def adopt(self, seen: Seen) -> None:
        """From now on show this."""
        self.seen = seen

    @property
    def troubles(self) -> list[str]:
        """What cannot be shown, a sentence each."""
        return [*self.seen.troubles.values(), *self.problems.values()]

    def scene(self) -> Scene | None:
        """Cameras, points, ball and support plane."""
        gate, trained = self._found("gate"), self._trained()
        marks = (gate and gate.mark, trained and trained.mark)
        return self._piece("cameras", marks, self._make_scene)

    def views(self) -> Views | None:
        """The photos, with the masks that were found."""
        found, masks = self._found("ingest"), self._found("masks")
        marks = (found and found.mark, masks and masks.mark)
        return self._piece("photos", marks, self._make_views)

    def thumbnail(self, camera: Camera, *, masked: bool) -> U8 | None:
        """(h, w, 3) sRGB: the photo of a camera as that sees it, dark around the object if asked.

        This one is not kept: it is made at each call.
        """
        views, scene = self.views(), self.scene()
        if views is None or scene is None:
            return None

        def make() -> U8:
            from refdgs_pipe.artifacts.photos import load_photo
            from refdgs_pipe.reporting.masks import draw_mask
            from refdgs_pipe.reporting.pictures import eight_bits

            scale = min(1.0, THUMBNAIL / max(camera.width, camera.height))
            photo = load_photo(views, scene.model, camera, scale=scale)
            if masked and photo.mask is not None:
                return draw_mask(photo)
            return eight_bits(photo.rgb)

        return self._guarded("photos", make)

    def mesh(self) -> tuple[TriangleMesh, str] | None:
        """The newest mesh, and the stage that made it."""
        found = {name: self._found(name) for name in ("shape", *_MESHES)}
        stage = max((n for n in found if found[n]), key=self._age, default=None)
        result = found[stage] if stage else None

        def make() -> tuple[TriangleMesh, str] | None:
            assert stage is not None and result is not None
            made = (
                load(Shape, result.folder).mesh
                if stage == "shape"
                else load(_MESHES[stage], result.folder)
            )
            if made is not None and len(made.faces) > MOST_FACES:
                raise CorruptError(
                    f"{stage}: {len(made.faces)} triangles are too many to show; the mesh of "
                    "`clean` has fewer"
                )
            return None if made is None or not len(made.faces) else (made, stage)

        return self._piece("mesh", (result and result.mark,), make)

    def asset(self) -> PlacedAsset | None:
        """The exported GLB."""
        found, scene, fit = self._found("export"), self.scene(), self._found("fit")
        gate = self._found("gate")
        marks = (found and found.mark, gate and gate.mark, fit and fit.mark)

        def make() -> PlacedAsset | None:
            assert found is not None
            if scene is None:
                return None
            path = found.folder / GLB
            if path.stat().st_size > _MOST_BYTES:
                raise CorruptError(f"{GLB} is too large to show")
            longest = found.manifest.origin.params.get("longest")
            metres = scene.model.metres_per_unit or 1.0
            if longest is not None and fit is not None:  # as the export has it
                box = np.ptp(load(Mesh, fit.folder).vertices, axis=0)
                metres = float(longest) / float(box.max())
            frame = AssetFrame.of(scene.model.up, metres)
            return PlacedAsset(path.read_bytes(), frame.turn.T, 1.0 / metres)

        return self._piece("asset", marks, make)

    def field(self) -> ShownField | None:
        """The field, as the newest checkpoint or result has it."""
        begun, trained = self.seen.begun, self._trained(also="train")
        if begun is not None and not begun.path.exists():  # its stage ended since the last look
            kept: ShownField | None = self._pieces.get("field", ((), None))[1]
            return kept
        if begun is not None and (trained is None or begun.made >= trained.made):
            marks: Marks = (begun.mark,)
        else:
            begun, marks = None, (trained and trained.mark,)

        def make() -> ShownField | None:
            if begun is not None:
                return self._unfinished(begun.path, begun.stage)
            assert trained is not None
            stage = trained.manifest.origin.stage
            kind: Any = SurfelField if stage == "refine" else Checkpoint
            made = load(kind, trained.folder)
            return ShownField(made if stage == "refine" else made.field, f"result of {stage}")

        return self._piece("field", marks, make)

    @property
    def newest(self) -> str:
        """What of the object was made last: "field", "mesh" or "asset"; "" if nothing was."""
        stages = {"train": "field", "refine": "field", "shape": "mesh", "export": "asset"}
        stages |= dict.fromkeys(_MESHES, "mesh")
        stages = {s: kind for s, kind in stages.items() if s in self.seen.results}
        last = max(stages, key=self._age, default=None)
        begun = self.seen.begun
        if begun is not None and (last is None or begun.made >= self.seen.results[last].made):
            return "field"
        return stages[last] if last else ""

    def _age(self, stage: str) -> tuple[float, int]:
        """What orders results: when they were made; within a second, in which order."""
        names = list(self.seen.results)
        return self.seen.results[stage].made, names.index(stage)

    def _found(self, stage: str) -> Found | None:
        return self.seen.results.get(stage)

    def _trained(self, also: str = "") -> Found | None:
        """The newest result of `refine`, or of another stage that makes a field."""
        found = [name for name in ("refine", also) if name in self.seen.results]
        return self.seen.results[max(found, key=self._age)] if found else None

    def _make_scene(self) -> Scene:
        gate, trained = self._found("gate"), self._trained()
        assert gate is not None
        model = load(SparseModel, gate.folder)
        plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
        if trained is not None:
            with suppress(RefdgsError):  # `field` says what is wrong with it
                field = load(SurfelField, trained.folder)
                model = model.placed(field.poses, field.ball)
        up = gate.manifest.origin.params.get("up")
        return Scene(model, plane, None if up is None else (up[0], up[1], up[2]))

    def _make_views(self) -> Views:
        found, masks = self._found("ingest"), self._found("masks")
        assert found is not None
        views = load(Views, found.folder)
        if masks is not None:
            made = load(Masks, masks.folder)
            views = made.applied(views, made.names)
        return views

    def _unfinished(self, path: Path, stage: str) -> ShownField | None:
        from refdgs_pipe.training.step import near_of
        from refdgs_pipe.training.unfinished import unfinished_field

        scene, light = self.scene(), self._found("lighting")
        if scene is None:
            return None
        lighting = WORLD if light is None else load(Lighting, light.folder)
        return ShownField(
            unfinished_field(path, near_of(scene.model), lighting), f"checkpoint of {stage}"
        )

    def _piece(self, name: str, marks: Marks, make: Callable[[], T | None]) -> T | None:
        """A piece, made anew if what it is made of has changed."""
        if name not in self._pieces or self._pieces[name][0] != marks:
            self.problems.pop(name, None)
            made = None if marks[0] is None else self._guarded(name, make)
            self._pieces[name] = (marks, made)
        found: T | None = self._pieces[name][1]
        return found

    def _guarded(self, name: str, make: Callable[[], T | None]) -> T | None:
        """What `make` returns; None, and a sentence, if it fails. Files are read while they change,
        and a workspace may come from another version: no failure ends the view."""
        try:
            return make()
        except Exception as error:
            words = str(error) if isinstance(error, RefdgsError) else type(error).__name__
            self.problems[name] = f"{name}: {printable(words)}. It is not shown"
            return None


def summary(seen: Seen, stages: Mapping[str, str]) -> list[tuple[str, str, float | None]]:
    """A row for each stage: its name, how it stands, and its seconds if it is done.

    Args:
        stages: name -> what it does, in order.
    """
    rows: list[tuple[str, str, float | None]] = []
    for name, does in stages.items():
        if name == seen.stage:
            story = seen.story
            count = f" {story.done}/{story.total}" if story.total else ""
            rows.append((name, f"running: {story.label or does}{count}", None))
        elif name in seen.troubles:
            rows.append((name, "damaged", None))
        elif name in seen.results:
            rows.append((name, "done", seen.results[name].manifest.seconds))
        else:
            rows.append((name, "of an older run" if name in seen.older else "", None))
    return rows
