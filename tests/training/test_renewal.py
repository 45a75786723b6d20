"""Surfels start anew on the field's own mesh, once, whatever interrupts the run."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from solids import cube_corners, joined, sphere
from training.test_trainer import SMALL, capture, quiet

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import Cancelled, MeshError
from refdgs_pipe.training.renewal import TURNING, discs_on, renewed
from refdgs_pipe.training.surfels import TrainableSet, raw_diffuse_of
from refdgs_pipe.training.trainer import Trainer

BALL = sphere(24)
HALFWAY = SMALL.model_copy(update={"renew_at": 0.5, "iterations": 20})


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
    trainer = Trainer(views, model, HALFWAY, tmp_path, surface=surface)
    counts = []
    while trainer.iteration < 20:
        trainer.step()
        counts.append(len(trainer.field.geometry))
    assert surface.asked == 1
    assert counts[10] == round(HALFWAY.renew_surfels * counts[9]) <= HALFWAY.most_surfels
    assert np.isfinite(trainer.loss)
    rates = {g["name"]: g["lr"] for g in trainer.field.geometry.optimizer.param_groups}
    plain = Trainer(views, model, HALFWAY, tmp_path)
    plain.field.set_rates(19 / 20)
    unchanged = {g["name"]: g["lr"] for g in plain.field.geometry.optimizer.param_groups}
    assert rates["quats"] == pytest.approx(TURNING * unchanged["quats"])
    assert rates["means"] == pytest.approx(unchanged["means"])


def test_no_surface_is_a_warning_and_one_is_never(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    said: list[str] = []
    surface = Surface(MeshError("nothing was fused"))
    field = Trainer(views, model, HALFWAY, tmp_path, warn=said.append, surface=surface).run(quiet)
    assert len(field.geometry) and surface.asked == 1
    assert said == ["surfels did not start anew, and normals are as they were: nothing was fused"]
    half = Surface(whole=False)
    (tmp_path / "half").mkdir()
    Trainer(views, model, HALFWAY, tmp_path / "half", warn=said.append, surface=half).run(quiet)
    assert half.asked == 1 and "shows only" in said[1]
    never = HALFWAY.model_copy(update={"renew_at": 1.0})
    (tmp_path / "never").mkdir()
    Trainer(views, model, never, tmp_path / "never", surface=surface).run(quiet)
    assert surface.asked == 1


@pytest.mark.parametrize("stop", [10, 14])
def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path: Path, stop: int) -> None:
    """Stopped while the mesh is made (10) and afterwards (14)."""
    views, model = capture(tmp_path / "views")

    def run(name: str, *fails: Exception | None) -> SurfelField:
        """As often as it takes: each time the surface fails so, or the watcher stops it."""
        (tmp_path / name).mkdir()
        for number, fail in enumerate((*fails, None)):

            def watch(done: int, total: int, now: object, work: float, last: int = number) -> None:
                if last < len(fails) and done >= stop:
                    raise Cancelled("stopped")

            surface = Surface(fail)
            trainer = Trainer(views, model, HALFWAY, tmp_path / name, surface=surface)
            try:
                found = trainer.run(watch)
            except Cancelled:
                continue
            return found
        raise AssertionError("it never ended")

    failure = Cancelled("stopped") if stop == 10 else None
    whole, parts = run("whole"), run("parts", failure)
    np.testing.assert_array_equal(whole.geometry.means, parts.geometry.means)
    np.testing.assert_array_equal(whole.geometry.quats, parts.geometry.quats)
