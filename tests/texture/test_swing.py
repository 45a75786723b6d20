"""Roughness and metal are told from how reflections swing, whatever the normals."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import gradient_sky
from solids import sphere

from refdgs_pipe.light import DIELECTRIC, Environment, reflected_share, texel_directions
from refdgs_pipe.received import links_of
from refdgs_pipe.texture.fitting import _corner_matrix
from refdgs_pipe.texture.sampling import Samples, seen_roughness
from refdgs_pipe.texture.swing import Swing

HEIGHT = 32
BALL = sphere(8)
PER_FACE = 200


def windows() -> np.ndarray:
    """A light with small bright windows."""
    sky = 0.2 * gradient_sky(texel_directions(HEIGHT).reshape(-1, 3)).reshape(HEIGHT, -1, 3)
    sky[6:9, 10:14], sky[12:15, 40:43], sky[20:22, 25:28] = 4.0, 6.0, 5.0
    return sky.astype(np.float32)


def swing(roughness: float, f0: float, footprint: float = 0.0) -> Swing:
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
    )
    corners = _corner_matrix(BALL, face, weights)
    return Swing(samples, corners, np.zeros((count, 3), np.float32), links_of(BALL.faces))


@pytest.mark.parametrize("roughness", [0.2, 0.3, 0.5])
@pytest.mark.parametrize("footprint", [0.0, 0.005])
def test_roughness_is_told_with_normals_that_are_all_wrong(
    roughness: float, footprint: float
) -> None:
    flat = np.zeros(len(BALL.vertices), np.float32)
    tint = np.full((len(flat), 3), 0.8, np.float32)
    told = swing(roughness, DIELECTRIC, footprint).roughness(Environment(windows()), flat, tint)
    assert abs(np.median(told) - roughness) < 0.03


@pytest.mark.parametrize("f0", [0.04, 0.5, 0.9])
def test_reflectance_is_told_with_normals_that_are_all_wrong(f0: float) -> None:
    rough = np.full(len(BALL.vertices), 0.2, np.float32)
    told = swing(0.2, f0).reflectance(Environment(windows()), rough)
    assert abs(np.median(told) / f0 - 1) < 0.3


def test_lamps_that_photos_clip_make_no_plastic_of_a_metal() -> None:
    """The light found may be brighter than any photo can show; only what is shown is compared."""
    metal = swing(0.1, 0.9)
    photos = replace(metal.samples, specular=np.minimum(metal.samples.specular, 1))
    found = np.where(windows() > 1, 3 * windows(), windows())
    rough = np.full(len(BALL.vertices), 0.1, np.float32)
    told = replace(metal, samples=photos).reflectance(Environment(found), rough)
    assert np.median(told) > 0.5


def test_a_metals_roughness_is_told_from_photos_and_a_glazes_from_the_field() -> None:
    """Photos are sharper than the field, but shadows and print swing in them too."""
    blurred, sharp = swing(0.5, 0.1), swing(0.2, 0.1)
    photo = np.clip(sharp.samples.radiance, 0, 1)
    both = replace(blurred, samples=replace(blurred.samples, photo=photo))
    tint = np.full((len(BALL.vertices), 3), 0.1, np.float32)
    light = Environment(windows())
    metal = both.roughness(light, np.ones(len(tint), np.float32), tint)
    assert abs(np.median(metal) - 0.2) < 0.03
    weaker = swing(0.5, DIELECTRIC)
    both = replace(weaker, samples=replace(weaker.samples, photo=photo))
    plastic = both.roughness(light, np.zeros(len(tint), np.float32), tint)
    assert abs(np.median(plastic) - 0.5) < 0.03


def test_what_bends_within_a_pixel_looks_rougher() -> None:
    assert seen_roughness(np.float32(0.3), np.float32(0.0)) == pytest.approx(0.3)
    assert seen_roughness(np.float32(0.1), np.float32(0.0256)) == pytest.approx(0.4, abs=1e-3)
