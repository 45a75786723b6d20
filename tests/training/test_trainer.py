"""Training: it learns, it resumes, its parts keep their laws."""

import json
import math
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from finished import field
from PIL import Image
from scenes import glossy_pair, orbit
from stage_runs import NO_MASKS
from training_runs import Settings, trainer_of

from refdgs_pipe.artifacts.lighting import WORLD
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField, SurfelSet
from refdgs_pipe.artifacts.views import Exif, KnownPose, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.errors import Cancelled, CorruptError, TrainingError
from refdgs_pipe.metrics import normal_error_deg, psnr
from refdgs_pipe.ops import Pinhole, clip, mirrored
from refdgs_pipe.ops.definition.shade import depth_normals, srgb_of
from refdgs_pipe.pipeline.events import Event, Progress, Sampled
from refdgs_pipe.pipeline.stage import Job
from refdgs_pipe.training import initial
from refdgs_pipe.training.begin import begin
from refdgs_pipe.training.checkpoint import NAME, read_checkpoint, write_checkpoint
from refdgs_pipe.training.render import render_image, render_surface_map
from refdgs_pipe.training.surfels import DensityRules, TrainableSet, densify

pytestmark = pytest.mark.usefixtures("coarse_start")

SMALL = Settings.of(
    {
        "start": {"volume_steps": 10, "look_steps": 0, "surfels": 1500, "local_surfels": 400},
        "train": {
            "iterations": 60,
            "max_surfels": 2500,
            "max_local_surfels": 600,
            "environment_height": 16,
            "densify_every": 20,
            "renew_at": 1.0,
        },
    }
)


def capture(folder: Path, *, size: int = 64, masked: bool = True) -> tuple[Views, SparseModel]:
    """Twelve views of the procedural pair, without going through files' readers."""
    scene, items = glossy_pair(), []
    cameras = orbit(12, size=size, focal=size * 1.4)
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    for camera in cameras:
        maps = scene.surface_map(camera)
        rgb = maps.color if masked else maps.color + 0.5 * (1 - maps.alpha[..., None])
        Image.fromarray(np.round(rgb * 255).astype(np.uint8)).save(
            folder / f"images/{camera.name}.png"
        )
        Image.fromarray(np.round(maps.alpha * 255).astype(np.uint8)).save(
            folder / f"masks/{camera.name}.png"
        )
        lens = Lens(camera.K, np.zeros(8))
        mask = f"masks/{camera.name}.png" if masked else None
        pose = KnownPose(lens, camera.cam_from_world)
        file = f"images/{camera.name}.png"
        items.append(
            View(camera.name, file, size, size, mask, "train", Exif(), 1, 0.5, pose, camera.name)
        )
    views = Views(folder, tuple(items), "srgb", "removed" if masked else "photo", ())
    points = np.random.default_rng(0).normal(size=(200, 3)) * 4 + (0, 0, 0)
    return views, model_of(cameras, points if not masked else np.zeros((0, 3)))


def model_of(cameras: list[Camera], points: np.ndarray) -> SparseModel:
    return SparseModel(
        cameras=tuple(cameras),
        lenses={c.name: Lens(c.K, np.zeros(8)) for c in cameras},
        points=points,
        point_colors=np.full((len(points), 3), 128, np.uint8),
        tracks={},
        ball=Ball(np.zeros(3), 1.6),
        up=np.array([0.0, 0, 1]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def thinned(field: SurfelField, every: int) -> SurfelField:
    """The field with one geometry surfel in `every` left."""
    part = field.geometry
    kept = SurfelSet(
        part.means[::every],
        part.quats[::every],
        part.scales[::every],
        part.opacities[::every],
        {name: value[::every] for name, value in part.values.items()},
    )
    return replace(field, geometry=kept)


def quiet(done: int, total: int, now: object, work: float) -> None:
    """A run that nobody watches."""


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def test_training_improves_the_picture_and_the_normals(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    camera = model.cameras[5]
    truth = glossy_pair().surface_map(camera)
    target = truth.color + (1 - truth.alpha[..., None])
    figures = []
    for steps in (1, 400):
        (tmp_path / str(steps)).mkdir()
        params = SMALL.but(iterations=steps)
        field = trainer_of(views, model, params, tmp_path / str(steps)).run(quiet)
        error = normal_error_deg(
            render_surface_map(field, camera).normal, truth.normal, truth.alpha > 0.5
        )
        figures.append((psnr(render_image(field, camera), target), error))
    (before, bent), (after, straight) = figures
    assert after > before + 4
    assert straight < bent
    trainer = trainer_of(views, model, params, tmp_path)
    assert trainer.coverage(field) > 0.6
    assert trainer.coverage(thinned(field, 200)) < 0.2  # an object that got lost is seen as lost


@pytest.mark.parametrize(
    ("changed", "masked"),
    [
        ({"local": "none"}, True),
        ({"local": "shared", "mixing": "sum"}, True),
        ({"physical": False}, True),
        ({"reflection": False}, True),
        ({"distortion_weight": 10.0, "smooth_weight": 0.1, "masked": "hull"}, True),
        ({"masked": "ball"}, True),
        ({}, False),
    ],
)
def test_every_variant_trains_and_survives_the_disk(
    tmp_path: Path, changed: dict[str, object], masked: bool
) -> None:
    views, model = capture(tmp_path / "views", masked=masked)
    params = SMALL.but(**{"iterations": 45, **changed})
    trainer = trainer_of(views, model, params, tmp_path)
    field = trainer.run(quiet)
    assert math.isfinite(trainer.loss)
    assert (len(field.background) > 0) == (not masked)
    field.save(tmp_path)
    camera = model.cameras[0]
    again = SurfelField.load(tmp_path)
    np.testing.assert_array_equal(render_image(field, camera), render_image(again, camera))


def test_an_interrupted_run_ends_bit_for_bit_like_an_undisturbed_one(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    whole = trainer_of(views, model, SMALL, tmp_path / "a").run(quiet)

    def stop_at_thirty(done: int, total: int, now: object, work: float) -> None:
        if done == 30:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        trainer_of(views, model, SMALL, tmp_path / "b").run(stop_at_thirty)
    resumed_from = []
    trainer = trainer_of(views, model, SMALL, tmp_path / "b")
    resumed = trainer.run(lambda done, total, now, work: resumed_from.append(done))
    assert resumed_from[0] == 40
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(
            getattr(whole.geometry, name), getattr(resumed.geometry, name)
        )
    np.testing.assert_array_equal(
        whole.geometry.values["diffuse"], resumed.geometry.values["diffuse"]
    )
    np.testing.assert_array_equal(whole.shader.environment, resumed.shader.environment)


def test_a_torn_checkpoint_is_as_good_as_none(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, {"x": torch.ones(3)}, "{}")
    assert read_checkpoint(tmp_path) is not None
    (tmp_path / NAME).write_bytes((tmp_path / NAME).read_bytes()[:20])
    assert read_checkpoint(tmp_path) is None


def test_a_loss_that_is_not_finite_ends_training_and_keeps_the_checkpoint(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    trainer = trainer_of(views, model, SMALL, tmp_path)
    trainer.step()
    trainer.save()
    with torch.no_grad():
        trainer.field.geometry.raw["raw_diffuse"].fill_(float("nan"))
    with pytest.raises(TrainingError, match="diverged at step 2"):
        trainer.step()
    found = read_checkpoint(tmp_path)
    assert found is not None
    assert all(bool(torch.isfinite(t.float()).all()) for t in found[0].values())


def test_without_training_views_the_error_says_so(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    held_out = tuple(
        Camera(c.name, c.width, c.height, c.K, c.cam_from_world, "test") for c in model.cameras
    )
    nothing = SparseModel(**{**vars(model), "cameras": held_out})
    with pytest.raises(TrainingError, match="no photo is left"):
        trainer_of(views, nothing, SMALL, tmp_path)


def test_a_damaged_field_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / "field.json").write_text("{}")
    with pytest.raises(CorruptError, match="not a readable surfel field"):
        SurfelField.load(tmp_path)


def test_a_field_keeps_the_ball_that_it_was_trained_in(tmp_path: Path) -> None:
    ball = Ball(np.array([0.1, 0.2, 0.3]), 0.6)
    replace(field(), ball=ball).save(tmp_path)
    found = SurfelField.load(tmp_path).ball
    assert found is not None
    np.testing.assert_array_equal(found.center, ball.center)
    assert found.radius == 0.6
    model = model_of([], np.zeros((0, 3)))
    assert model.placed({}, found).ball is found
    assert model.placed({}).ball is model.ball
    record = json.loads((tmp_path / "field.json").read_text())
    record["ball"]["radius"] = -1
    (tmp_path / "field.json").write_text(json.dumps(record))
    with pytest.raises(CorruptError, match="not a readable surfel field"):
        SurfelField.load(tmp_path)


def a_set(n: int = 6) -> TrainableSet:
    raw = {
        "means": torch.arange(3 * n).reshape(n, 3).float(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        "log_scales": torch.full((n, 2), math.log(0.1)),
        "raw_opacities": torch.zeros(n),
        "features": torch.arange(4 * n).reshape(n, 4).float(),
    }
    return TrainableSet(raw, dict.fromkeys(raw, 0.1))


def test_densification_clones_splits_and_prunes_what_it_should() -> None:
    group = a_set()
    with torch.no_grad():
        group.raw["log_scales"][1] = math.log(0.5)  # large: split
        group.raw["raw_opacities"][2] = -8.0  # faint: gone
        group.raw["log_scales"][3] = math.log(9.0)  # huge: gone
    group.gradient_sum[:] = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    group.seen[:] = 1
    keep = torch.tensor([True, True, True, True, True, False])
    rules = DensityRules(gradient=0.5, split_size=0.2, largest=1.0, opacity=0.05, most=100)
    densify(group, rules, keep, torch.Generator().manual_seed(0))
    first = group.raw["features"][:, 0].tolist()
    assert sorted(first) == [0, 0, 4, 4, 16]  # 0 cloned, 1 split, 4 kept, the others gone
    o = torch.sigmoid(group.raw["raw_opacities"].detach())
    pair = o[group.raw["features"][:, 0] == 0]
    assert float(1 - (1 - pair).prod()) == pytest.approx(0.5, abs=1e-5)


def test_densification_never_exceeds_its_cap() -> None:
    group = a_set(50)
    group.gradient_sum[:] = torch.rand(50, generator=torch.Generator().manual_seed(1)) + 1
    group.seen[:] = 1
    rules = DensityRules(gradient=0.5, split_size=9.0, largest=10.0, opacity=0.01, most=60)
    densify(group, rules, torch.ones(50, dtype=torch.bool), torch.Generator().manual_seed(0))
    assert len(group) == 60


def test_depth_normals_of_a_tilted_plane_are_its_normal() -> None:
    view = Pinhole(torch.eye(4), 50.0, 50.0, 16.0, 12.0, 32, 24)
    n = torch.tensor([0.3, -0.2, -0.9])
    n = n / n.norm()
    x = ((torch.arange(32) + 0.5 - 16) / 50)[None, :].expand(24, 32)
    y = ((torch.arange(24) + 0.5 - 12) / 50)[:, None].expand(24, 32)
    depth = (n[2] * 4) / (n[0] * x + n[1] * y + n[2])
    found = depth_normals(depth, view)[1:-1, 1:-1]
    assert float((found * n).sum(-1).min()) > 1 - 1e-5


def test_a_clipped_highlight_can_only_be_pulled_down() -> None:
    x = torch.tensor([0.5, 2.0, 2.0], requires_grad=True)
    (clip(x, 1.0) * torch.tensor([1.0, 1.0, -1.0])).sum().backward()
    assert x.grad.tolist() == [1.0, 1.0, 0.0]
    assert float(srgb_of(torch.tensor(7.0))) == pytest.approx(1.0)


def test_the_hull_of_a_ball_seen_from_all_sides_is_the_ball() -> None:
    cameras = orbit(30, size=96, focal=130)
    ball = Ball(np.zeros(3), 1.4)
    masks = []
    for camera in cameras:
        rays = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        miss = np.linalg.norm(np.cross(rays, -camera.center), axis=-1)
        masks.append((miss < 1).astype(np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial, "HULL_CELLS", 96)
        hull = initial.visual_hull(ball, cameras, masks)
    assert hull is not None
    rng = np.random.default_rng(0)
    cloud = initial.surface_cloud(hull, 2000, rng, cameras, masks, 1.5)
    radii = np.linalg.norm(cloud.points, axis=1)
    assert np.quantile(np.abs(radii - 1), 0.9) < 0.02  # a cell is 0.03 wide
    outward = (cloud.normals * cloud.points).sum(1) / radii
    assert np.median(outward) > 0.95
    inside = initial.volume_cloud(hull, 2000, np.random.default_rng(0))
    assert np.median(np.linalg.norm(inside.points, axis=1)) < 0.85


def test_the_work_behind_grows_to_one_and_late_steps_weigh_more(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    shares: list[float] = []
    trainer_of(views, model, SMALL, tmp_path).run(
        lambda done, total, now, work: shares.append(work)
    )
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)
    assert shares[1] - shares[0] < 0.6 * (shares[-1] - shares[-2])


def test_specular_radiance_weighs_where_there_are_pixels() -> None:
    radiance = torch.tensor([[3.0, 0.0, 0.0], [0.0, 6.0, 0.0], [math.nan, 1.0, 1.0]])
    radiance.requires_grad_()
    mean = mirrored(radiance, torch.tensor([4, 7, -1]), 10)
    assert mean.item() == pytest.approx(9 / 30)
    mean.backward()  # type: ignore[no-untyped-call]
    assert radiance.grad is not None
    assert radiance.grad.tolist() == [[pytest.approx(1 / 30)] * 3] * 2 + [[0.0] * 3]


def test_what_diffuse_colour_explains_is_diffuse_in_the_end(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    shares = []
    for weight in (0.0, 3.0):
        params = SMALL.but(specular_weight=weight, specular_from=0.2)
        field = trainer_of(views, model, params, tmp_path / str(weight)).run(lambda *_: None)
        seen = render_surface_map(field, model.cameras[0])
        shares.append(float(seen.specular.sum() / (seen.specular + seen.diffuse).sum()))
    assert shares[1] < 0.8 * shares[0]


def test_how_much_reflections_turn_normals_is_a_setting(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    turned = []
    for share in (0.0, 1.0):
        params = SMALL.but(turn_share=share, masked="ball", local_from=1.0)
        trainer = trainer_of(views, model, params, tmp_path / str(share))
        for _ in range(3):  # the map is one grey before the first, and turns nothing
            trainer.step()
        moments = trainer.field.geometry.optimizer.state[trainer.field.geometry.raw["quats"]]
        turned.append(float(moments["exp_avg"].norm()))
    assert 0 < turned[1] != turned[0]


def test_the_stage_tells_figures_as_data_and_in_words(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", size=32)
    few = SMALL.but(iterations=20, surfels=200, local_surfels=100)
    begun = begin(views, model, few.start, tmp_path)
    stage, told = import_module("refdgs_pipe.stages.train").train, list[Event]()
    (tmp_path / "scratch").mkdir()
    job = Job("train", tmp_path, tmp_path / "scratch", "cpu", 1, told.append)
    stage.run(views, NO_MASKS, model, WORLD, begun.start, few.train, job)
    samples = [event for event in told if isinstance(event, Sampled)]
    assert [(event.step, event.steps) for event in samples] == [(10, 20), (20, 20)]
    last = samples[-1].figures
    assert last.keys() == {"loss", "psnr", "surfels"} and last["psnr"] > 0
    (spoken,) = [e for e in told if isinstance(e, Progress) and e.done == 20 and e.note]
    assert spoken.note.startswith(f"loss {last['loss']:.4f}  PSNR {last['psnr']:.2f} dB  ")
