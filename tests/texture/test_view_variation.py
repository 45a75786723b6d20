"""Roughness and metal are estimated from how reflections vary, whatever the normals."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import gradient_sky
from solids import sphere

from refdgs_pipe.irradiance import links_of
from refdgs_pipe.light import DIELECTRIC, Environment, reflected_share, texel_directions
from refdgs_pipe.texture.matrices import corner_matrix
from refdgs_pipe.texture.sampling import Samples, seen_roughness
from refdgs_pipe.texture.view_variation import ViewVariation

HEIGHT = 32
BALL = sphere(8)
PER_FACE = 200


def windows() -> np.ndarray:
    """A light with small bright windows."""
    sky = 0.2 * gradient_sky(texel_directions(HEIGHT).reshape(-1, 3)).reshape(HEIGHT, -1, 3)
    sky[6:9, 10:14], sky[12:15, 40:43], sky[20:22, 25:28] = 4.0, 6.0, 5.0
    return sky.astype(np.float32)


def variation(roughness: float, f0: float, footprint: float = 0.0) -> ViewVariation:
    """Samples of a ball whose normals are all wrong: any place mirrors any direction."""
    random = np.random.default_rng(1)
    count = PER_FACE * len(BALL.faces)
    face = np.repeat(np.arange(len(BALL.faces)), PER_FACE)
    weights = np.full((count, 3), 1 / 3, np.float32)

    def directions() -> np.ndarray:
        found = random.normal(size=(count, 3))
        return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)

    cosine = np.full(count, 0.8, np.float32)
    seen = np.full(count, seen_roughness(np.float32(roughness), np.float32(footprint)), np.float32)
    mirrored = Environment(windows()).mirrored(directions(), seen)
    rough = np.full((count, 1), roughness, np.float32)
    share = reflected_share(np.full((count, 3), f0, np.float32), rough, cosine[:, None])
    samples = Samples(
        face,
        weights,
        cosine,
        directions(),
        np.full(count, -1),
        np.zeros((count, 3), np.float32),
        np.full((count, 3), 0.3, np.float32),
        mirrored * share,
        np.clip(0.3 + mirrored * share, 0, 1),
        rough[:, 0],
        np.full(count, footprint, np.float32),
        np.arange(count) % PER_FACE,
    )
    corners = corner_matrix(BALL, face, weights)
    return ViewVariation(samples, corners, np.zeros((count, 3), np.float32), links_of(BALL.faces))


def plastic() -> tuple[Environment, np.ndarray, np.ndarray]:
    """The light, no metal, and a tint that nothing has."""
    tint = np.full((len(BALL.vertices), 3), 0.8, np.float32)
    return Environment(windows()), np.zeros(len(tint), np.float32), tint


@pytest.mark.parametrize("roughness", [0.2, 0.3, 0.5])
@pytest.mark.parametrize("footprint", [0.0, 0.005])
def test_roughness_is_told_with_normals_that_are_all_wrong(
    roughness: float, footprint: float
) -> None:
    told = variation(roughness, DIELECTRIC, footprint).roughness(*plastic())
    assert abs(np.median(told) - roughness) < 0.03


@pytest.mark.parametrize("f0", [0.04, 0.5, 0.9])
def test_reflectance_is_told_with_normals_that_are_all_wrong(f0: float) -> None:
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    told = variation(0.2, f0).reflectance(Environment(windows()), rough)
    assert abs(np.median(told) / f0 - 1) < 0.3


def test_lamps_that_photos_clip_make_no_plastic_of_a_metal() -> None:
    """The light found may be brighter than any photo can show; only what is shown is compared."""
    metal = variation(0.1, 0.9)
    photos = replace(metal.samples, specular=np.minimum(metal.samples.specular, 1))
    found = np.where(windows() > 1, 3 * windows(), windows())
    rough = np.full(len(BALL.vertices), 0.1, np.float32)
    told = replace(metal, samples=photos).reflectance(Environment(found), rough)
    assert np.median(told) > 0.5


def photographed(field: ViewVariation, photo: ViewVariation, noise: float = 0.0) -> ViewVariation:
    """What one shows in its field and the other in its photos, with noise added."""
    shown = photo.samples.photo + noise * np.random.default_rng(2).normal(size=(len(photo.near), 1))
    samples = replace(field.samples, photo=np.clip(shown, 0, 1).astype(np.float32))
    return replace(field, samples=samples)


@pytest.mark.parametrize("metal", [0, 1])
def test_roughness_is_told_from_photos_which_are_sharper_than_the_field(metal: int) -> None:
    f0 = (DIELECTRIC, 0.1)[metal]
    both = photographed(variation(0.35, f0), variation(0.2, f0))
    light, flat, tint = plastic()
    told = both.roughness(light, flat + np.float32(metal), np.full_like(tint, f0))
    assert abs(np.median(told) - 0.2) < 0.03


def test_print_that_varies_in_photos_alone_makes_nothing_glossy() -> None:
    both = photographed(variation(0.7, DIELECTRIC), variation(0.7, DIELECTRIC), noise=0.1)
    assert abs(np.median(both.roughness(*plastic())) - 0.7) < 0.1


def test_what_mirrors_no_light_from_afar_is_told_by_its_neighbours_or_taken_for_glossy() -> None:
    plain = variation(0.5, DIELECTRIC)
    lower = BALL.vertices[BALL.faces].mean(1)[plain.samples.face, 2] < 0
    for hidden, told in ((lower, 0.5), (np.ones_like(lower), 0.16)):
        near = np.where(hidden, 0, plain.samples.near_face)
        found = replace(plain, samples=replace(plain.samples, near_face=near)).roughness(*plastic())
        below = BALL.vertices[:, 2] < 0.9 * BALL.vertices[:, 2].min()
        assert abs(np.median(found[below]) - told) < 0.05


def test_what_bends_within_a_pixel_looks_rougher() -> None:
    assert seen_roughness(np.float32(0.3), np.float32(0.0)) == pytest.approx(0.3)
    assert seen_roughness(np.float32(0.1), np.float32(0.0256)) == pytest.approx(0.4, abs=1e-3)


LIT = Environment(windows())
DARK = Environment(np.zeros_like(windows()))  # beside the ground nothing is mirrored


def over_brown_ground(f0: float, paint: float) -> ViewVariation:
    """As `variation`, but all that is mirrored is a ground of little contrast, which is known."""
    plain = variation(0.2, f0)
    random = np.random.default_rng(3)
    count = len(plain.near)
    light = 0.1 + 0.03 * random.normal(size=(count, 1)) * np.array([1.0, 0.7, 0.5])
    light = np.clip(light, 0, 1).astype(np.float32)
    levels = np.repeat(np.concatenate([light, np.ones((count, 1))], 1)[:, None], 5, axis=1)
    rough = np.full((count, 1), 0.2, np.float32)
    share = reflected_share(
        np.full((count, 3), f0, np.float32), rough, plain.samples.cosine[:, None]
    )
    specular = (light * share).astype(np.float32)
    diffuse = np.full((count, 3), paint, np.float32)
    samples = replace(
        plain.samples,
        ground=levels.astype(np.float32),
        specular=specular,
        diffuse=diffuse,
        photo=np.clip(diffuse + specular, 0, 1),
    )
    return replace(plain, samples=samples, below=samples.ground[..., :3])


def windowed(plain: ViewVariation) -> ViewVariation:
    """The same where the ground's light is known, but nothing mirrors it."""
    nothing = np.zeros((len(plain.near), 5, 4), np.float32)
    photo = np.clip(plain.samples.specular, 0, 1)
    samples = replace(plain.samples, ground=nothing, photo=photo)
    return replace(plain, samples=samples, below=nothing[..., :3])


def test_a_metal_is_told_by_a_ground_that_varies_little() -> None:
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    told = over_brown_ground(0.65, 0.0).reflectance(DARK, rough)
    assert np.median(told) > 0.5


def test_paint_of_the_same_brightness_is_no_metal() -> None:
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    told = over_brown_ground(0.04, 0.065).reflectance(DARK, rough)
    assert np.median(told) < 0.12


def painted(seen: ViewVariation, photo: np.ndarray) -> ViewVariation:
    """Photos that the field repeats as a colour, with hardly any reflection."""
    specular = (0.01 * seen.samples.specular).astype(np.float32)
    return replace(seen, samples=replace(seen.samples, specular=specular, photo=photo))


def test_a_metal_whose_reflections_the_field_has_painted_is_told_by_photos() -> None:
    """In each view, all of it mirrors one direction."""
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    metal = windowed(variation(0.2, 0.65))
    photo = np.clip(metal.samples.specular, 0, 1)[metal.samples.view]
    assert np.median(painted(metal, photo).reflectance(LIT, rough)) > 0.4


def test_a_fine_print_that_photos_show_through_a_wrong_mesh_is_no_metal() -> None:
    """Each view shows another place of it."""
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    matte = windowed(variation(0.2, 0.04))
    random = np.random.default_rng(5)
    photo = np.where(random.random((len(matte.near), 1)) < 0.5, 0.1, 0.8).astype(np.float32)
    photo = np.repeat(photo, 3, axis=1)
    assert np.median(painted(matte, photo).reflectance(LIT, rough)) < 0.2


def test_nothing_reflects_more_than_is_seen() -> None:
    """Black plastic whose reflections vary for other reasons, say a wrong shape."""
    black = over_brown_ground(0.04, 0.0)
    random = np.random.default_rng(4)
    noise = np.abs(0.02 * random.normal(size=black.samples.specular.shape)).astype(np.float32)
    samples = replace(black.samples, specular=black.samples.specular + noise)
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    told = replace(black, samples=samples).reflectance(DARK, rough)
    assert np.median(told) < 0.15


def test_the_colour_of_a_metal_is_told_by_the_ground_that_it_mirrors() -> None:
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    metal = over_brown_ground(0.65, 0.0)
    _, tint = metal.tint(DARK, rough, np.ones(len(rough), np.bool_))
    assert np.abs(np.median(tint, axis=0) - 0.65).max() < 0.05
