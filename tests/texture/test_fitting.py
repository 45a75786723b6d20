"""Material and light are told apart where the views say enough."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import Scene, Sphere, constant, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import CorruptError, MeshError
from refdgs_pipe.light import texel_directions
from refdgs_pipe.texture.fitting import Plan, fit, matte
from refdgs_pipe.texture.sampling import Sampler, Samples

HEIGHT = 32
SILVER = Sphere((-0.55, 0, 0), 0.5, constant(0, 0, 0), specular=(0.9, 0.85, 0.8))
PLASTIC = Sphere((0.55, 0, 0), 0.5, waves, specular=(0.04, 0.04, 0.04))
SKY = gradient_sky(texel_directions(HEIGHT).reshape(-1, 3)).reshape(HEIGHT, -1, 3)


def two_balls() -> TriangleMesh:
    left, right = (sphere(16, center=solid.center, radius=0.5) for solid in (SILVER, PLASTIC))
    return TriangleMesh(
        np.concatenate([left.vertices, right.vertices]),
        np.concatenate([left.faces, right.faces + len(left.vertices)]),
    )


def samples_of(scene: Scene, mesh: TriangleMesh) -> Samples:
    sampler = Sampler(mesh, tolerance=0.03, per_view=1500)
    for camera in orbit(24):
        sampler.add(scene.surface_map(camera))
    return sampler.samples()


@pytest.fixture(scope="module")
def fitted() -> Appearance:
    mesh = two_balls()
    guess = (0.1 * SKY).astype(np.float32)  # the right picture in the wrong unit
    samples = samples_of(Scene((SILVER, PLASTIC), gradient_sky), mesh)
    # The procedural views show no reflections between the balls.
    alone = replace(samples, near_face=np.full_like(samples.near_face, -1))
    return fit(mesh, alone, guess, lift=0.01, metal=True, plan=Plan(epochs=(40, 10, 10, 20)))


def test_a_mirror_is_metal_and_glossy_plastic_is_not(fitted: Appearance) -> None:
    silver = fitted.points[:, 0] < 0
    assert np.median(fitted.metallic[silver]) > 0.8
    assert np.median(fitted.metallic[~silver]) < 0.1
    assert np.median(fitted.roughness[silver]) < 0.3


def test_the_fit_does_not_depend_on_the_number_of_threads() -> None:
    import torch

    mesh, plan = two_balls(), Plan(epochs=(3, 2, 2, 2))
    samples = samples_of(Scene((SILVER, PLASTIC), gradient_sky), mesh)
    light, before = (0.1 * SKY).astype(np.float32), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            made = fit(mesh, samples, light, lift=0.01, metal=True, plan=plan)
            found.append(made)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for made in found[1:]:
        assert made.environment is not None and found[0].environment is not None
        assert made.roughness.tobytes() == found[0].roughness.tobytes()
        assert made.metallic.tobytes() == found[0].metallic.tobytes()
        assert made.environment.tobytes() == found[0].environment.tobytes()


def test_a_metal_is_told_whose_mean_the_field_calls_diffuse() -> None:
    """As after training that weighs specular radiance: only what differs is mirrored."""
    samples = samples_of(Scene((SILVER, PLASTIC), gradient_sky), two_balls())
    alone = replace(samples, near_face=np.full_like(samples.near_face, -1))
    silver = (alone.face < len(sphere(16).faces))[:, None]
    least = np.where(silver, 0.8 * alone.specular[silver[:, 0]].min(0), 0).astype(np.float32)
    moved = replace(alone, diffuse=alone.diffuse + least, specular=alone.specular - least)
    found = fit(two_balls(), moved, (0.1 * SKY).astype(np.float32), lift=0.01, metal=True)
    left = found.points[:, 0] < 0
    assert np.median(found.metallic[left]) > 0.8
    assert np.median(found.metallic[~left]) < 0.1


def test_what_varies_as_a_metal_but_mirrors_nothing_is_none() -> None:
    """As where the mesh lies behind the surface: its colours are those of other places."""
    samples = samples_of(Scene((SILVER, PLASTIC), gradient_sky), two_balls())
    alone = replace(samples, near_face=np.full_like(samples.near_face, -1))
    silver = alone.face < len(sphere(16).faces)
    random = np.random.default_rng(0)
    specular = alone.specular.copy()
    specular[~silver] = random.choice(specular[silver], int((~silver).sum()))
    mixed = replace(alone, specular=specular)
    light = (0.1 * SKY).astype(np.float32)
    plan = Plan(epochs=(20, 10, 10, 5))
    found = fit(two_balls(), mixed, light, lift=0.01, metal=True, plan=plan)
    left = found.points[:, 0] < 0
    assert np.median(found.metallic[left]) > 0.7
    assert np.median(found.metallic[~left]) < 0.2


def test_metal_is_decided_in_the_end(fitted: Appearance) -> None:
    """Artists expect metal or none, but for soft borders."""
    assert ((fitted.metallic > 0.2) & (fitted.metallic < 0.8)).mean() < 0.1


def test_the_lights_unit_is_found_from_what_mirrors_it(fitted: Appearance) -> None:
    assert fitted.environment is not None
    assert 0.6 < fitted.environment.mean() / SKY.mean() < 1.7


def test_the_light_does_not_keep_the_colour_of_what_mirrors_it() -> None:
    mesh = two_balls()
    samples = samples_of(Scene((SILVER, PLASTIC), gradient_sky), mesh)
    alone = replace(samples, near_face=np.full_like(samples.near_face, -1))
    guess = (0.1 * SKY * np.array([1.8, 0.7, 0.8])).astype(np.float32)
    found = fit(mesh, alone, guess, lift=0.01, metal=True)
    assert found.environment is not None
    cast = np.log(found.environment.mean((0, 1)) / SKY.mean((0, 1)))
    assert np.ptp(cast) < 0.28  # 0.9 in the guess
    silver = np.median(found.tint[found.points[:, 0] < 0], 0)
    assert silver[0] > 0.88 * silver[1]  # not cyan


def test_openness_is_what_the_other_ball_leaves_of_the_sky(fitted: Appearance) -> None:
    facing = np.abs(fitted.points[:, 0]) < 0.15
    away = np.abs(fitted.points[:, 0]) > 0.9
    assert fitted.openness[away].min() > 0.99
    assert fitted.openness[facing].max() < 0.85


def test_a_matte_field_has_no_light_of_its_own() -> None:
    looks = matte(two_balls(), lift=0.01)
    assert looks.environment is None and looks.metallic.max() == 0 and looks.roughness.min() == 1


def test_a_sample_has_the_photos_colour_where_the_photo_shows_the_object() -> None:
    """Whatever the photo's exposure: here it is darker, striped, and half of it tells nothing."""
    scene, mesh = Scene((SILVER, PLASTIC), gradient_sky), two_balls()
    view = scene.surface_map(orbit(24)[5])
    linear = 0.8 * (view.diffuse + view.specular)
    linear[:, ::8] = 0.3
    photo = np.asarray(srgb_from_linear(np.clip(linear, 0, 1)), np.float32)
    photo[:, : photo.shape[1] // 2] = np.nan
    plain, told = (Sampler(mesh, tolerance=0.03, per_view=1500) for _ in range(2))
    plain.add(view)
    told.add(view, photo=photo)
    field, found = plain.samples(), told.samples()
    np.testing.assert_array_equal(field.photo, np.clip(field.radiance, 0, 1))
    striped = np.abs(found.photo - 0.3 / 0.8).max(1) < 0.01
    assert 0.02 < striped.mean() < 0.15
    dark = ~striped & (field.photo.max(1) < 0.75)  # what 0.8 of it is not clipped
    np.testing.assert_allclose(found.photo[dark], field.photo[dark], rtol=0.02, atol=0.004)


def test_samples_are_taken_all_over_a_picture() -> None:
    """Too many places for the number wanted: the lower ones count no less than the upper ones."""
    mesh = two_balls()
    few, all_of_them = (Sampler(mesh, tolerance=0.03, per_view=n) for n in (200, 10**6))
    for sampler in (few, all_of_them):
        sampler.add(Scene((SILVER, PLASTIC), gradient_sky).surface_map(orbit(24)[5]))
    heights = [
        (mesh.vertices[mesh.faces[taken.face]] * taken.weights[..., None]).sum(1)[:, 2]
        for taken in (few.samples(), all_of_them.samples())
    ]
    assert len(heights[0]) == 200 and len(heights[1]) > 800
    parts = np.quantile(heights[1], [0.25, 0.5, 0.75])
    share = np.bincount(np.searchsorted(parts, heights[0]), minlength=4) / 200
    assert np.abs(share - 0.25).max() < 0.12


def test_a_part_off_the_field_is_sampled_where_nothing_nearer_shows_it() -> None:
    """Like a bulge of the field that was made flat: its colours count, its normals do not."""
    mesh, count = two_balls(), len(sphere(16).faces)
    true, off = (
        [Scene((silver, PLASTIC), gradient_sky).surface_map(camera) for camera in orbit(8)]
        for silver in (SILVER, replace(SILVER, radius=0.56))
    )
    turned = [replace(view, normal=view.normal[..., [1, 2, 0]]) for view in off]

    def taken(views: list[SurfaceMap]) -> Samples:
        sampler = Sampler(mesh, tolerance=0.03, per_view=10**6)
        for view in views:
            sampler.add(view)
        return sampler.samples()

    found, same = taken(off), taken(turned)
    left, as_left = found.face < count, same.face < count
    assert left.sum() > 0.5 * (taken(true).face < count).sum()
    np.testing.assert_array_equal(found.mirrored[left], same.mirrored[as_left])
    both = taken(true + off)
    assert (both.view < 8)[both.face < count].all()


def test_without_any_sample_there_is_no_fit() -> None:
    mesh = two_balls()
    far = TriangleMesh(mesh.vertices + np.float32(50), mesh.faces)
    with pytest.raises(MeshError, match="no view shows any part of the mesh"):
        samples_of(Scene((SILVER,), gradient_sky), far)


def test_an_appearance_comes_back_as_it_was(fitted: Appearance, tmp_path) -> None:  # type: ignore[no-untyped-def]
    fitted.save(tmp_path)
    again = Appearance.load(tmp_path)
    np.testing.assert_array_equal(again.tint, fitted.tint)
    np.testing.assert_array_equal(again.environment, fitted.environment)
    (tmp_path / "appearance.safetensors").write_bytes(b"no")
    with pytest.raises(CorruptError, match="run the stage appearance again"):
        Appearance.load(tmp_path)
