"""The pipeline from Python. Its names are those of the package; docs/python.md shows their use."""

import os
import threading
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe import recipe as recipes
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.cli import report as reports
from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.device import choose_device, core_count, let_waiting_threads_sleep
from refdgs_pipe.cli.running import Options, bring_up_to
from refdgs_pipe.cli.signals import Stopper
from refdgs_pipe.cli.verdict import verdict_of
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import InputError
from refdgs_pipe.pipeline.catalog import PUBLISHED
from refdgs_pipe.pipeline.events import Emit
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.pipeline.store import load

PathLike: TypeAlias = str | os.PathLike[str]
T = TypeVar("T", bound=Artifact)
SILENT = -1


@dataclass(frozen=True)
class Result:
    """What a run came to.

    Args:
        workspace: the folder of all results; the `load_...` functions take it.
        asset: the folder of the exported files; None if the run ended before the export.
        report: the HTML page; None if it was not asked for or could not be written.
        made: stage -> seconds, of the stages that were run now; the others were up to date.
        measures: stage -> figure -> value, as the stages measured them.
        warnings: what makes the result worse than it could be.
        verdict: "good", "fair" or "poor" (docs/verdict.md); None without an asset.
    """

    workspace: Path
    asset: Path | None
    report: Path | None
    made: dict[str, float]
    measures: dict[str, dict[str, float | int | str]]
    warnings: tuple[str, ...]
    verdict: str | None


def run(
    photos: PathLike | Iterable[PathLike],
    *,
    workspace: PathLike | None = None,
    recipe: PathLike | None = None,
    settings: Mapping[str, Any] | None = None,
    until: str | None = None,
    again: Iterable[str] = (),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int = 0,
    vram: int = 0,
    cuda_graph: bool | None = None,
    report: bool = True,
    listen: Emit = lambda _: None,
    stop: threading.Event | None = None,
) -> Result:
    """Make the asset, and whatever of the way to it is missing, as `refdgs-pipe run` does.

    Args:
        photos: a folder, a file or several of them; or a workspace to go on with.
        workspace: where results go; None: PHOTOS.refdgs beside the photos.
        recipe: a name or a TOML file; None: glossy, or what the workspace remembers.
        settings: "stage.setting" -> value; they win over the recipe.
        until: make only this stage and what it needs.
        again: stages to run again, even if they are up to date.
        threads: CPU threads; 0: every core.
        vram: GPU memory to keep within, in bytes; 0: all that is free.
        cuda_graph: repeat recorded GPU steps: always, never, or (None) where they prove equal.
        report: whether to write report.html.
        listen: hears every event of `refdgs_pipe.pipeline.events`. Nothing is printed.
        stop: set it, from another thread or in `listen`, to end the run at the next safe point.

    Raises:
        InputError: a setting, a recipe or a named file is wrong.
        CaptureError: the photos cannot be used.
        Cancelled: `stop` was set. What is finished is kept; the next run goes on.
        RefdgsError: any other thing that went wrong, in words.
    """
    let_waiting_threads_sleep()
    space = spaces.open_for_run(
        _paths(photos),
        None if workspace is None else Path(workspace),
        None if recipe is None else os.fspath(recipe),
        [recipes.assignment(name, value) for name, value in (settings or {}).items()],
        tell=_warn,
    )
    options = Options(
        until=space.stage_name(until) if until else None,
        force=frozenset(space.stage_name(name) for name in again),
        device=device,
        threads=threads,
        verbosity=SILENT,
        vram=vram,
        cuda_graph=cuda_graph,
    )
    stopper = Stopper()  # not entered: signals are the caller's
    stopper.stop = stop or stopper.stop
    steps, made = bring_up_to(space, options, stopper=stopper, also=listen)
    page = reports.write_if_possible(space, threads=threads) if report else None
    return _result(space, steps, made, page)


def load_field(workspace: PathLike) -> SurfelField:
    """The trained field of a workspace: surfels, environment and shader.

    Raises:
        InputError: it is not a workspace, or training has no current result.
    """
    return _load(workspace, SurfelField)


def load_cameras(
    workspace: PathLike, split: Literal["train", "test", "all"] = "all"
) -> list[Camera]:
    """The cameras of a workspace's photos, placed as its field was trained, in world units.

    Raises:
        InputError: it is not a workspace, or training has no current result.
    """
    field = _load(workspace, SurfelField)
    model = _load(workspace, SparseModel).placed(field.poses, field.ball)
    return [camera for camera in model.cameras if split in ("all", camera.split)]


def load_mesh(workspace: PathLike) -> TexturedMesh:
    """The textured mesh of a workspace as arrays, in world units.

    Raises:
        InputError: it is not a workspace, or nothing is baked.
    """
    return _load(workspace, TexturedMesh)


def load_asset(workspace: PathLike) -> Asset:
    """The exported files of a workspace: their folder, names, sizes and hashes.

    Raises:
        InputError: it is not a workspace, or nothing is exported.
    """
    return _load(workspace, Asset)


def render(
    field: SurfelField,
    camera: Camera,
    *,
    backdrop: tuple[float, float, float] = (1.0, 1.0, 1.0),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int = 0,
) -> NDArray[np.float32]:
    """(H, W, 3) sRGB picture in [0, 1] of what the camera sees, over a backdrop colour.

    Raises:
        DeviceError: the device cannot be used.
    """
    let_waiting_threads_sleep()
    from refdgs_pipe.training.render import render_image

    chosen, count = choose_device(device), threads or core_count()
    return render_image(field, camera, backdrop=backdrop, device=chosen, threads=count)


def _result(
    space: Workspace, steps: Sequence[Step], made: dict[str, float], report: Path | None
) -> Result:
    done = {step.stage.name: step.manifest for step in steps if step.manifest}
    folders = [space.root / folder for stage, folder in PUBLISHED.items() if stage in done]
    verdict = verdict_of(space)
    return Result(
        workspace=space.root,
        asset=folders[0] if folders else None,
        report=report,
        made=made,
        measures={n: {name: v for name, v, _ in m.measures} for n, m in done.items()},
        warnings=tuple(text for manifest in done.values() for text in manifest.warnings),
        verdict=verdict.word if verdict else None,
    )


def _load(workspace: PathLike, kind: type[T]) -> T:
    """The current result of the stage that makes this kind of artifact."""
    space = spaces.open_workspace(Path(workspace), tell=_warn)
    return load(kind, space.result(kind.__name__)[1])


def _paths(photos: PathLike | Iterable[PathLike]) -> list[Path]:
    given = [photos] if isinstance(photos, str | os.PathLike) else list(photos)
    if not given:
        raise InputError("photos: none were given. Give a folder, or at least one file")
    return [Path(path) for path in given]


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=2)
