"""Light looked up, blurred and received is what the integrals say."""

import numpy as np
import pytest
import torch
from solids import sphere

from refdgs_pipe.irradiance import look_around
from refdgs_pipe.light import (
    ROUGHNESSES,
    Environment,
    blur,
    ggx_lobe,
    level_weights,
    looked_up,
    passed_share,
    reflected_share,
    reflection_line,
    solid_angles,
    texel_directions,
)
from refdgs_pipe.ray_casting import Solid, cosine_rays, half_vectors

RANDOM = np.random.default_rng(0)


def unit(count: int) -> np.ndarray:
    found = RANDOM.normal(size=(count, 3))
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def test_texels_cover_the_sphere_once_and_look_themselves_up() -> None:
    assert solid_angles(16).sum() == pytest.approx(4 * np.pi)
    picture = RANDOM.random((16, 32, 3)).astype(np.float32)
    np.testing.assert_allclose(looked_up(picture, texel_directions(16)), picture, atol=1e-5)


def test_even_light_stays_even_however_rough() -> None:
    even = Environment(np.full((32, 64, 3), 2.0, np.float32))
    for roughness in (0.0, 0.15, 0.5, 1.0):
        found = even.mirrored(unit(50), np.full(50, roughness, np.float32))
        np.testing.assert_allclose(found, 2, rtol=1e-5)
    np.testing.assert_allclose(even.scattered(unit(50)), 2, rtol=1e-5)


@pytest.mark.parametrize("height", [64, 128])
def test_light_is_blurred_as_ggx_says(height: int) -> None:
    around = texel_directions(height).reshape(-1, 3)
    slope = np.array([0.48, -0.6, 0.64])

    def bright(directions: np.ndarray) -> np.ndarray:
        return np.repeat(np.exp(3 * directions @ slope)[:, None], 3, axis=1)

    light = Environment(bright(around).reshape(height, -1, 3).astype(np.float32))
    towards = np.concatenate([slope[None], unit(20)]).astype(np.float32)
    size = solid_angles(height).reshape(-1)
    for roughness in ROUGHNESSES[1:]:
        weights = ggx_lobe(towards @ around.T, roughness) * size
        exact = weights @ bright(around) / weights.sum(1, keepdims=True)
        found = light.mirrored(towards, np.full(len(towards), roughness, np.float32))
        # the texels of the blurred pictures are up to 11 degrees wide
        np.testing.assert_allclose(found, exact, rtol=0.03, atol=0.02)


def test_the_levels_weights_add_up() -> None:
    rough = np.linspace(ROUGHNESSES[0], 1, 40)
    np.testing.assert_allclose(sum(level_weights(rough)), 1, atol=1e-6)


@pytest.mark.parametrize("height", [16, 128])
def test_the_gradient_of_the_blur_is_its_transpose(height: int) -> None:
    blurring = blur(height)
    picture = RANDOM.random((2 * height**2, 3)).astype(np.float32)
    levels = blurring(picture)
    gradients = [RANDOM.random(level.shape).astype(np.float32) for level in levels]
    forward = sum(float((a * b).sum()) for a, b in zip(levels, gradients, strict=True))
    assert forward == pytest.approx(float((blurring.transposed(gradients) * picture).sum()), 1e-4)


def test_what_is_mirrored_is_f0_straight_on_and_all_at_grazing() -> None:
    smooth = np.full((2, 1), 0.02, np.float32)
    share = reflected_share(np.float32([[0.04], [0.04]]), smooth, np.float32([[1], [0.0]]))
    assert share[0, 0] == pytest.approx(0.04, abs=0.01)
    assert share[1, 0] > 0.9


def test_the_roughest_mirror_seen_straight_on_is_known_in_closed_form() -> None:
    """GGX with alpha 1: the integral of n.l / (n.l + 1) from 0 to 1."""
    one = np.ones((1, 1), np.float32)
    scale, offset = reflection_line(one, one)
    assert float((scale + offset)[0, 0]) == pytest.approx(1 - np.log(2), abs=2e-3)


@pytest.mark.parametrize("roughness", [0.2, 0.35, 0.6, 0.9])
@pytest.mark.parametrize("cosine", [0.15, 0.5, 0.9])
def test_the_mirrored_share_is_the_integral_over_directions(
    roughness: float, cosine: float
) -> None:
    """By rays spread evenly over the half sphere of incoming light, unlike the table's."""
    polar, turn = np.meshgrid(
        (np.arange(2000) + 0.5) / 2000, (np.arange(500) + 0.5) / 500 * np.pi, indexing="ij"
    )
    light = np.sqrt(1 - polar**2)[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    eye = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    half = np.concatenate([light, polar[..., None]], -1) + eye
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    alpha2, n_h, v_h = roughness**4, half[..., 2], half @ eye
    density = alpha2 / (np.pi * (n_h**2 * (alpha2 - 1) + 1) ** 2)
    masked = polar * np.sqrt(cosine**2 * (1 - alpha2) + alpha2)
    masked += cosine * np.sqrt(polar**2 * (1 - alpha2) + alpha2)
    share = density * 0.5 / masked * polar * 2 * np.pi
    fresnel = (1 - v_h) ** 5
    rough, across = (np.full((1, 1), v, np.float32) for v in (roughness, cosine))
    scale, offset = reflection_line(rough, across)
    assert float(scale[0, 0]) == pytest.approx((share * (1 - fresnel)).mean(), abs=0.01)
    assert float(offset[0, 0]) == pytest.approx((share * fresnel).mean(), abs=0.01)


def test_tensors_have_the_mirrored_share_of_arrays_and_its_slope() -> None:
    rough = RANDOM.uniform(0.1, 0.95, (50, 1)).astype(np.float32)
    across = RANDOM.uniform(0.05, 0.95, (50, 1)).astype(np.float32)
    asked = torch.from_numpy(rough).requires_grad_()
    found = reflection_line(asked, torch.from_numpy(across))
    for tensor, array in zip(found, reflection_line(rough, across), strict=True):
        np.testing.assert_allclose(tensor.detach().numpy(), array, atol=1e-6)
    found[0].sum().backward()  # type: ignore[no-untyped-call]
    step = np.float32(1e-3)
    up, down = (reflection_line(rough + d, across)[0] for d in (step, -step))
    assert asked.grad is not None
    within = np.abs(rough * 32 % 1 - 0.5) < 0.4  # both in one cell of the table
    slope = (up - down) / (2 * step)
    np.testing.assert_allclose(asked.grad.numpy()[within], slope[within], atol=2e-3)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_half_vectors_have_the_density_of_ggx(alpha: float) -> None:
    """A share u of them lies within an angle whose squared tangent is alpha^2 u / (1 - u)."""
    normals = unit(300).astype(np.float32)
    each = np.full((300, 1), alpha, np.float32)
    found = np.concatenate([half_vectors(normals, each, 32, i) for i in range(32)])
    cosine = (found * np.tile(normals, (32, 1))).sum(1).astype(np.float64)
    square = 1 / cosine**2 - 1
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    for share in (0.25, 0.5, 0.75):
        within = alpha**2 * share / (1 - share)
        assert (square < within).mean() == pytest.approx(share, abs=0.04)


def test_what_a_smooth_layer_mirrors_is_not_scattered() -> None:
    smooth = np.full((3, 1), 0.1, np.float32)
    cosine = np.float32([[1], [0.3], [0.02]])
    passed = passed_share(smooth, cosine)
    mirrored = reflected_share(np.full((3, 1), 0.04, np.float32), smooth, cosine)
    np.testing.assert_allclose(passed + mirrored, 1, atol=1e-6)
    assert passed[0] > 0.94 and passed[2] < 0.3


def test_rays_about_a_normal_have_the_cosines_mean() -> None:
    normals = unit(200)
    heights = [(cosine_rays(normals, 64, i) * normals).sum(1) for i in range(64)]
    assert np.mean(heights) == pytest.approx(2 / 3, abs=0.01)
    assert np.min(heights) > 0


def test_a_ball_in_the_open_receives_the_whole_sky_and_one_inside_none() -> None:
    ball = sphere(16)
    sky = look_around(ball.vertices, ball.faces, ball.vertices, lift=0.01)
    even = Environment(np.full((16, 32, 3), 0.5, np.float32))
    nothing = np.zeros_like(ball.vertices)
    np.testing.assert_allclose(sky.received(even, nothing), 0.5, rtol=1e-4)
    np.testing.assert_allclose(sky.openness, 1)
    inward = look_around(ball.vertices, ball.faces, -ball.vertices, lift=0.01)
    np.testing.assert_allclose(inward.received(even, nothing + 0.25), 0.25, rtol=1e-4)


def test_rays_meet_what_is_first() -> None:
    ball = sphere(24)
    origins = np.float32([[0, 0, 3], [0, 0, 3]])
    hits = Solid(ball.vertices, ball.faces).first(origins, np.float32([[0, 0, -1], [0, 0, 1]]))
    assert hits.rays.tolist() == [0]
    assert hits.distance[0] == pytest.approx(2, abs=0.02)
