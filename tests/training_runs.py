"""Whole trainings in one call, as the stages start, train, shape and refine do them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import MeshError
from refdgs_pipe.training.begin import begin
from refdgs_pipe.training.budget import Load
from refdgs_pipe.training.figures import Progress
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.renewal import Renewal
from refdgs_pipe.training.settings import RefineParams, StartParams, TrainParams
from refdgs_pipe.training.trainer import Trainer


@dataclass(frozen=True)
class Settings:
    """Those of all parts of a training."""

    start: StartParams
    train: TrainParams
    refine: RefineParams

    @classmethod
    def of(cls, settings: Mapping[str, Mapping[str, Any]]) -> "Settings":
        """From tables as a recipe has them: stage -> setting -> value."""
        kinds = {"start": StartParams, "train": TrainParams, "refine": RefineParams}
        return cls(**{n: kind.model_validate(settings.get(n, {})) for n, kind in kinds.items()})

    def but(self, **changes: Any) -> "Settings":
        """With other values of some settings of `start` and `train`."""
        mine = {n: v for n, v in changes.items() if n in StartParams.model_fields}
        rest = {n: v for n, v in changes.items() if n not in mine}
        assert rest.keys() <= TrainParams.model_fields.keys()
        start, train = self.start.model_copy(update=mine), self.train.model_copy(update=rest)
        return replace(self, start=start, train=train)


def trainer_of(
    views: Views,
    model: SparseModel,
    settings: Settings,
    folder: Path,
    *,
    photos: list[TrainingPhoto] | None = None,
    starting: Callable[[int, int], None] | None = None,
    device: str = "cpu",
    **options: Any,
) -> Trainer:
    """The first part of a training, with its start."""
    folder.mkdir(parents=True, exist_ok=True)
    begun = begin(
        views, model, settings.start, folder, device=device, photos=photos, progress=starting
    )
    options = {"device": device, "photos": photos, **options}
    return Trainer(views, model, begun.start, settings.train, folder, **options)


def refiner_of(
    first: Trainer,
    views: Views,
    model: SparseModel,
    settings: Settings,
    folder: Path,
    surface: Callable[[SurfelField], TriangleMesh],
    **options: Any,
) -> Trainer:
    """The second part of a training whose first part has run in `first`."""
    folder.mkdir(parents=True, exist_ok=True)
    before = first.checkpoint(first.frozen())
    load = Load(settings.train, first.start, growth=settings.refine.surfels)
    try:
        mesh, why_not = surface(before.field), ""
    except MeshError as error:
        mesh, why_not = None, str(error)
    p = settings.refine
    renewal = Renewal(mesh, why_not, p.surfels, load.most, p.turning)
    return Trainer(
        views, model, first.start, settings.train, folder, after=before, renewal=renewal, **options
    )


def trained(
    views: Views,
    model: SparseModel,
    settings: Settings,
    folder: Path,
    *,
    surface: Callable[[SurfelField], TriangleMesh],
    progress: Progress = lambda *_: None,
    **options: Any,
) -> SurfelField:
    """Both parts of a training."""
    first = trainer_of(views, model, settings, folder / "first", **options)
    field = first.run(progress)
    if first.position >= settings.train.iterations:
        return field
    second = refiner_of(first, views, model, settings, folder / "second", surface, **options)
    return second.run(progress)
