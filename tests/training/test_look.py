"""Photos without masks: what is the object's, what is the ground's, and where to start."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from finished import field
from safetensors.torch import load_file, save_file
from scenes import glossy_pair, orbit
from training.test_trainer import SMALL, capture, model_of, quiet
from training_runs import trainer_of

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField, SurfelSet
from refdgs_pipe.errors import Cancelled
from refdgs_pipe.training.ground import Surroundings, ground_below, left_to_background
from refdgs_pipe.training.look import limited, look
from refdgs_pipe.training.losses import out_of_place
from refdgs_pipe.training.photos import load_training_photos, shrunk
from refdgs_pipe.training.step import NEAR

LOOKING = SMALL.but(look_steps=120, look_scale=1.0, coarse=1.0)
RADIUS = 1.6


def on_a_table(share: float) -> SparseModel:
    """A model of 200 sparse points of which a share lies on the plane z = 0."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (200, 3))
    points[: int(200 * share), 2] = rng.normal(0, 0.002, int(200 * share))
    return model_of([], points)


def test_the_ground_under_photos_is_not_the_objects() -> None:
    around = Surroundings(on_a_table(0.5), ground=True)
    points = torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, 0.1], [0.1, 0.2, -0.5], [0, 0, 1.7]])
    assert around.objects(points).tolist() == [False, True, False, False]
    assert around.objects(points, 1.1).tolist() == [False, True, False, True]


def test_without_points_on_it_or_if_not_wanted_there_is_no_ground() -> None:
    below = torch.tensor([[0.1, 0.2, -0.5]])
    assert Surroundings(on_a_table(0.05), ground=True).objects(below).all()
    assert Surroundings(on_a_table(0.5), ground=False).objects(below).all()


def test_a_field_tells_whether_its_ground_is_the_backgrounds() -> None:
    def with_object(*heights: float, behind: int = 3) -> SurfelField:
        means = np.array([[0.1, 0.2, z] for z in heights], np.float32)
        plain = field()
        return replace(plain, geometry=surfels(means), background=surfels(np.ones((behind, 3))))

    above = with_object(0.1, 0.4)
    assert left_to_background(on_a_table(0.5), above)
    assert not left_to_background(on_a_table(0.05), above)  # no ground was found
    assert not left_to_background(on_a_table(0.5), with_object(0.0, 0.4))  # it is the object's
    assert not left_to_background(on_a_table(0.5), with_object(0.1, behind=0))


def test_gaps_are_closed_on_a_ground_that_is_known_and_not_the_objects() -> None:
    def ground(share: float, behind: int, lowest: float, *, one_side: bool = False) -> bool:
        all_round = [c for c in orbit(24) if c.center[2] > 0]
        cameras = [c for c in all_round if c.center[0] > 0] if one_side else all_round
        model = replace(on_a_table(share), cameras=tuple(cameras))
        means = np.array([[0.1, 0.2, lowest], [0.1, 0.2, 0.4]])
        one = replace(field(), geometry=surfels(means), background=surfels(np.ones((behind, 3))))
        up = ground_below(model, one)
        assert up is None or np.array_equal(up, model.up)
        return up is not None

    assert ground(0.5, 3, 0.1)
    assert ground(0.5, 0, 0.0)  # masks leave the ground out
    assert not ground(0.5, 3, 0.0)  # the field holds the ground
    assert not ground(0.05, 3, 0.1)  # no ground was found
    assert not ground(0.5, 3, 0.1, one_side=True)  # what is behind is not the inside


def surfels(means: np.ndarray) -> SurfelSet:
    count = len(means)
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    return SurfelSet(
        means.astype(np.float32), quats, np.ones((count, 2), np.float32), np.ones(count), {}
    )


def test_surfels_start_where_the_look_found_the_object(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False)
    photos = load_training_photos(views, model, max_side=64, near=NEAR)
    params = LOOKING.but(look_steps=1, masked="hull")
    look(params.start, model, photos, tmp_path, near=NEAR)
    kept = {name: t.clone() for name, t in load_file(tmp_path / "look.safetensors").items()}
    for i, photo in enumerate(photos):
        alpha = glossy_pair().surface_map(photo.camera).alpha
        kept[f"mask {i}"] = torch.from_numpy(np.round(alpha * 255).astype(np.uint8))
    save_file(kept, tmp_path / "look.safetensors")
    trainer = trainer_of(views, model, params, tmp_path)
    assert trainer.full[0].mask is None  # a mask that was found is not a mask that is kept to
    seen = trainer.field.geometry.raw["means"].detach().double().numpy()
    uv, _ = photos[0].camera.project(seen)
    column, row = np.floor(uv[((uv >= 0) & (uv < 64)).all(1)]).astype(int).T
    inside = kept["mask 0"].numpy()[row, column] > 0
    assert inside.mean() > 0.6  # 0.25 throughout the ball; cells off some photos survive


def test_what_was_found_is_not_looked_for_again(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False)
    photos = load_training_photos(views, model, max_side=64, near=NEAR)
    params = LOOKING.but(look_steps=5)
    first = look(params.start, model, photos, tmp_path, near=NEAR)

    def never(done: int, total: int) -> None:
        raise AssertionError("it looked again")

    again = look(params.start, model, photos, tmp_path, near=NEAR, progress=never)
    torch.testing.assert_close(first.background["sh"], again.background["sh"], rtol=0, atol=0)
    for a, b in zip(first.photos, again.photos, strict=True):
        assert a.mask is not None and b.mask is not None
        assert torch.equal(a.mask, b.mask)


def test_a_run_without_masks_ends_alike_wherever_it_was_stopped(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False, size=32)
    small = {"look_steps": 20, "iterations": 20, "volume_steps": 0, "masked": "hull"}
    params = LOOKING.but(**small)
    for name in "ab":
        (tmp_path / name).mkdir()
    whole = trainer_of(views, model, params, tmp_path / "a").run(quiet)

    def stop_looking(done: int, total: int) -> None:
        if done == 10:
            raise Cancelled("enough")

    def stop_training(done: int, total: int, now: object, work: float) -> None:
        if done == 10:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        trainer_of(views, model, params, tmp_path / "b", starting=stop_looking)
    with pytest.raises(Cancelled):
        trainer_of(views, model, params, tmp_path / "b").run(stop_training)
    resumed = trainer_of(views, model, params, tmp_path / "b").run(quiet)
    np.testing.assert_array_equal(whole.geometry.means, resumed.geometry.means)
    np.testing.assert_array_equal(whole.background.means, resumed.background.means)


def test_masks_that_are_there_are_not_looked_for(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    trainer_of(views, model, LOOKING, tmp_path)
    assert not list(tmp_path.glob("look*"))


def test_a_look_that_finds_nothing_forbids_nothing(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False, size=32)
    params = LOOKING.but(look_steps=1)
    photos = load_training_photos(views, model, max_side=32, near=NEAR)
    look(params.start, model, photos, tmp_path, near=NEAR)
    kept = {name: t.clone() for name, t in load_file(tmp_path / "look.safetensors").items()}
    kept |= {name: torch.zeros_like(t) for name, t in kept.items() if name.startswith("mask")}
    save_file(kept, tmp_path / "look.safetensors")
    found = look(params.start, model, photos, tmp_path, near=NEAR)
    assert all(photo.mask is None for photo in found.photos)
    assert all(photo.beyond is None for photo in limited(found.photos))


def test_only_what_lies_beyond_the_object_costs() -> None:
    alpha = torch.tensor([[0.0, 0.5], [0.5, 1.0]], dtype=torch.float64, requires_grad=True)
    beyond = torch.tensor([[True, True], [False, False]])
    loss = out_of_place(alpha, beyond)
    assert loss.item() == pytest.approx(np.log(2) / 4)
    loss.backward()
    assert alpha.grad is not None
    assert alpha.grad.tolist() == [[0.25, 0.5], [0, 0]]


def test_a_look_says_where_nothing_of_the_object_is_near(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False)
    (photo, *_) = load_training_photos(views, model, max_side=64, near=NEAR)
    mask = torch.zeros(64, 64, dtype=torch.uint8)
    mask[20:40, 20:40] = 255
    (seen,) = limited([replace(photo, mask=mask)])
    assert seen.mask is None and seen.beyond is not None
    assert not seen.beyond[19:41, 19:41].any()
    assert seen.beyond[:18].all() and seen.beyond[:, 42:].all()
    half = shrunk(seen, 0.5).beyond
    assert half is not None and half.shape == (32, 32)
    assert not half[9:21, 9:21].any() and half[:9].all()
