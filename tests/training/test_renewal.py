"""Surfels start anew on the field's own mesh, once, whatever interrupts the run."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from solids import cube_corners, joined, sphere
from training.test_trainer import SMALL, capture, quiet
from training_runs import Settings, refiner_of, trained, trainer_of

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import Cancelled, MeshError
from refdgs_pipe.training.figures import Progress
from refdgs_pipe.training.renewal import discs_on, renewed
from refdgs_pipe.training.surfels import TrainableSet, raw_diffuse_of

pytestmark = pytest.mark.usefixtures("coarse_start")

BALL = sphere(24)
HALFWAY = SMALL.but(renew_at=0.5, iterations=20)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_discs_lie_evenly_on_the_mesh_and_look_outwards() -> None:
    cloud = discs_on(BALL, 4000, np.random.default_rng(0))
    distance = np.linalg.norm(cloud.points, axis=1)
    assert distance.min() > 0.97 and distance.max() < 1.0001
    outward = (cloud.normals * cloud.points).sum(1) / distance
    assert outward.min() > 0.99
    for axis in range(3):  # Archimedes: evenly along any axis
        assert abs(np.quantile(cloud.points[:, axis], 0.25) + 0.5) < 0.03
    # a quarter of the area of the discs' one-sigma circles is about that of the ball
    assert 4000 * cloud.sizes[0] ** 2 == pytest.approx(0.36 * 4 * np.pi, rel=0.02)


def test_renewed_surfels_carry_what_the_nearest_carried() -> None:
    means = torch.tensor([[1.5, 0.0, 0.0], [-1.5, 0, 0]])
    colors = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.1, 0.8]])
    raw = {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]] * 2),
        "log_scales": torch.zeros(2, 2),
        "raw_opacities": torch.zeros(2),
        "raw_diffuse": raw_diffuse_of(colors),
        "raw_roughness": torch.tensor([0.5, -0.5]),
    }
    group = TrainableSet(raw, dict.fromkeys(raw, 0.01))
    fresh = renewed(group, BALL, 100, np.random.default_rng(0))
    assert len(fresh.frozen(group)) == 100 and len(group) == 2
    fresh.replace(group)
    assert len(group) == 100
    right = group.raw["means"][:, 0] > 0
    assert (group.raw["raw_roughness"] == torch.where(right, 0.5, -0.5)).all()
    assert (torch.sigmoid(group.raw["raw_opacities"]) > 0.8).all()


BALL_OF_PAIR = sphere(24, center=(-0.45, 0, 0.1), radius=0.5)


def box_of_pair() -> TriangleMesh:
    corners = cube_corners() * np.float32([0.7, 0.7, 0.8]) + np.float32([0.2, -0.4, -0.4])
    return TriangleMesh(corners, ConvexHull(corners).simplices.astype(np.int32))


class Surface:
    """The mesh of the procedural pair, as a trainer asks for it."""

    def __init__(self, fails: Exception | None = None, *, whole: bool = True) -> None:
        self.asked, self.fails = 0, fails
        self.mesh = joined(BALL_OF_PAIR, box_of_pair()) if whole else BALL_OF_PAIR

    def __call__(self, field: SurfelField) -> TriangleMesh:
        self.asked += 1
        if self.fails is not None:
            raise self.fails
        return self.mesh


def test_a_run_starts_anew_once_and_goes_on(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    surface = Surface()
    first = trainer_of(views, model, HALFWAY, tmp_path / "first")
    first.run(quiet)
    assert first.iteration == 10
    second = refiner_of(first, views, model, HALFWAY, tmp_path / "second", surface)
    second.run(quiet)
    assert surface.asked == 1 and second.iteration == 20
    before, after = len(first.field.geometry), len(second.field.geometry)
    assert after == round(HALFWAY.refine.surfels * before)
    assert np.isfinite(second.loss)
    rates = {g["name"]: g["lr"] for g in second.field.geometry.optimizer.param_groups}
    first.field.set_rates(19 / 20)
    unchanged = {g["name"]: g["lr"] for g in first.field.geometry.optimizer.param_groups}
    assert rates["quats"] == pytest.approx(HALFWAY.refine.turning * unchanged["quats"])
    assert rates["means"] == pytest.approx(unchanged["means"])


def test_no_surface_is_a_warning_and_one_is_never(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    said: list[str] = []
    surface = Surface(MeshError("nothing was fused"))

    def run(name: str, settings: Settings, surface: Surface) -> SurfelField:
        return trained(views, model, settings, tmp_path / name, surface=surface, warn=said.append)

    field = run("none", HALFWAY, surface)
    assert len(field.geometry) and surface.asked == 1
    assert said == ["surfels did not start anew, and normals are as they were: nothing was fused"]
    half = Surface(whole=False)
    run("half", HALFWAY, half)
    assert half.asked == 1 and "shows only" in said[1]
    run("never", HALFWAY.but(renew_at=1.0), surface)
    assert surface.asked == 1 and len(said) == 2
    run("short", HALFWAY.but(iterations=1), surface)
    assert surface.asked == 1 and said[2].endswith("the run ended before (train.renew_at)")


@pytest.mark.parametrize("stop", [10, 14, 20])
def test_an_interrupted_run_ends_as_one_that_was_not(
    tmp_path: Path, stop: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped as the first part ends (10), in the second one, and at its end."""
    views, model = capture(tmp_path / "views")

    def watch(done: int, total: int, now: object, work: float) -> None:
        if done >= stop:
            raise Cancelled("stopped")

    def run(name: str, progress: Progress) -> SurfelField:
        surface = Surface()
        return trained(views, model, HALFWAY, tmp_path / name, surface=surface, progress=progress)

    monkeypatch.setattr("refdgs_pipe.training.trainer.REPORT_STEPS", 2)
    whole = run("whole", quiet)
    with pytest.raises(Cancelled):
        run("parts", watch)
    parts = run("parts", quiet)
    for name in ("means", "quats", "opacities"):
        ours, theirs = getattr(whole.geometry, name), getattr(parts.geometry, name)
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(whole.shader.environment, parts.shader.environment)
