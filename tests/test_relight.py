"""The little renderer that scores the asset in its own light."""

from dataclasses import replace

import numpy as np
import pytest
from painted import textured
from scenes import look_at

from refdgs_pipe.artifacts.lighting import BANDS, Flash, Lighting, Ring, Turntable
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.relight import Relit, offsets, rays_of

SKY = np.full((16, 32, 3), 0.5, np.float32)
CAMERA = look_at("v", np.array([4.0, 0.5, 1.0]), size=48, focal=55)


def test_a_matte_ball_in_even_light_sends_what_it_receives_times_its_colour() -> None:
    """Nothing hides the sky from a ball, so that it receives the sky's 0.5 everywhere."""
    ball = textured()
    grey = np.full_like(ball.base_color, 48059)  # sRGB 0.7333, linear 0.4969
    plain = replace(
        ball,
        base_color=grey,
        roughness=np.full_like(ball.roughness, 65535),
        metallic=np.zeros_like(ball.metallic),
    )
    picture, alpha = Relit(plain, SKY).draw(CAMERA)
    linear = ((picture[alpha == 1] + 0.055) / 1.055) ** 2.4
    assert 0.5 * 0.497 - 0.01 < np.median(linear) < 0.5 * 0.497 + 0.03  # and 4 % that it mirrors


def test_between_two_mirrors_a_third_place_is_seen() -> None:
    """A ray down onto a mirror goes up to another one and down again: to the matte ball's foot."""
    ball = textured()
    mirror = replace(
        ball,
        base_color=np.full_like(ball.base_color, 65535),
        roughness=np.zeros_like(ball.roughness),
        metallic=np.full_like(ball.metallic, 65535),
    )
    relit = Relit(mirror, SKY)
    down = np.float32([[0, 0, -1]])
    start = np.float32([0, 0, 1])  # its centre: every ray meets it from within, again and again
    hits = relit.solid.first(start, down)
    relit._sent[:] = 7.0
    lit = [relit._seen(hits, down, more)[0, 0] for more in (0, 1)]
    assert lit[0] == pytest.approx(7.0)
    assert lit[1] > 3.0  # of the vertices met next, not of the sky's 0.5


def metal(roughness: int) -> TexturedMesh:
    """The ball of white metal; roughness in 65535ths."""
    ball = textured()
    return replace(
        ball,
        base_color=np.full_like(ball.base_color, 65535),
        roughness=np.full_like(ball.roughness, roughness),
        metallic=np.full_like(ball.metallic, 65535),
    )


def test_a_rough_ball_does_not_mirror_itself() -> None:
    """Some half vectors of a wide lobe lead into the ball; such rays do not count."""
    relit = Relit(metal(40000), SKY)
    before = relit.draw(CAMERA)[0]
    relit._sent[:] = 7.0
    np.testing.assert_allclose(relit.draw(CAMERA)[0], before, atol=0.02)


def test_a_mirror_shows_the_ground_below_it_and_the_sky_above() -> None:
    red = np.zeros((64, 64, 4), np.float32)
    red[..., 0], red[..., 3] = 0.7, 1
    ground = GroundLight(red, np.array([0, 0, -1.2]), np.eye(3)[0], np.eye(3)[1], 20.0)
    picture, alpha = Relit(metal(0), SKY, ground=ground).draw(CAMERA)
    row = np.flatnonzero((alpha == 1).any(1))
    low, high = picture[row[-3]][alpha[row[-3]] == 1], picture[row[2]][alpha[row[2]] == 1]
    assert np.median(low[:, 0]) > 0.7 and np.median(low[:, 1]) < 0.3
    assert np.ptp(np.median(high, axis=0)) < 0.1


def test_outlines_are_drawn_with_sixteen_rays_and_the_rest_with_four() -> None:
    _, alpha = Relit(textured(), SKY).draw(CAMERA)
    edge = alpha[(alpha > 0) & (alpha < 1)]
    np.testing.assert_allclose(edge * 16, np.round(edge * 16), atol=1e-5)
    assert (np.abs(edge * 4 - np.round(edge * 4)) > 0.1).mean() > 0.3


def test_rays_of_pixels_go_through_their_centres_and_beside_them() -> None:
    pixels = np.array([0, 49, 48 * 48 - 1])
    whole = CAMERA.pixel_rays().reshape(-1, 3)[pixels] @ CAMERA.cam_from_world[:3, :3]
    whole /= np.linalg.norm(whole, axis=1, keepdims=True)
    np.testing.assert_allclose(rays_of(CAMERA, pixels), whole, atol=1e-6)
    points = CAMERA.center + 3.0 * rays_of(CAMERA, pixels, (0.25, -0.5))
    seen, _ = CAMERA.project(points)
    row, column = np.divmod(pixels, 48)
    np.testing.assert_allclose(seen, np.stack([column + 0.75, row + 0.0], 1), atol=1e-3)


def test_rays_share_out_a_pixel_evenly() -> None:
    assert offsets(1) == [(0.0, 0.0)]
    np.testing.assert_allclose(np.mean(offsets(4), axis=0), 0, atol=1e-12)
    assert len(set(offsets(4))) == 16 and np.abs(offsets(4)).max() == 0.375


def half_lit() -> np.ndarray:
    """A room whose light comes from +x."""
    room = np.full((16, 32, 3), 0.05, np.float32)
    room[:, :8], room[:, 24:] = 0.9, 0.9
    return room


def test_on_a_turntable_every_photo_has_the_room_s_light_from_the_same_side() -> None:
    """The ball looks alike from all sides of its table, because it is lit by the camera's room."""
    table = Turntable(np.zeros(3), np.array([0.0, 0, 1]), (Ring(1.0, 4.0),), np.zeros((BANDS, 3)))
    ball = textured()
    grey = replace(ball, base_color=np.full_like(ball.base_color, 40000))
    cameras = [
        look_at("v", np.array([4 * np.cos(a), 4 * np.sin(a), 1.0]), size=48, focal=55)
        for a in (0.0, 2.0)
    ]
    still, moving = (
        Relit(grey, half_lit()),
        Relit(grey, half_lit(), lighting=Lighting("turntable", "", table)),
    )
    apart = [
        float(np.abs(np.subtract(*(r.draw(c)[0] for c in cameras))).mean()) for r in (still, moving)
    ]
    assert apart[1] < 0.25 * apart[0]


def test_a_flash_lights_what_faces_the_camera() -> None:
    ball = textured()
    matte = replace(
        ball,
        base_color=np.full_like(ball.base_color, 48059),  # linear 0.4969
        roughness=np.full_like(ball.roughness, 65535),
        metallic=np.zeros_like(ball.metallic),
    )
    flash = Lighting("flash", "", flash=Flash(np.zeros(3), 3.1, 0.0))
    dark = np.zeros((16, 32, 3), np.float32)
    picture, alpha = Relit(matte, dark, lighting=flash, white=0.6).draw(CAMERA)
    linear = ((picture + 0.055) / 1.055) ** 2.4
    rows, columns = np.nonzero(alpha == 1)
    middle = linear[int(rows.mean()), int(columns.mean())]
    assert middle == pytest.approx([0.6 * 0.497] * 3, rel=0.1)
    assert linear[alpha == 1].min() < 0.5 * middle.min()


def test_the_picture_does_not_depend_on_the_number_of_threads() -> None:
    one, two = (Relit(metal(20000), half_lit(), threads=n).draw(CAMERA) for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_textures_are_looked_up_between_texels_in_linear_light() -> None:
    ball = textured()
    stripes = np.zeros_like(ball.base_color)
    stripes[:, 1::2] = 65535
    relit = Relit(replace(ball, base_color=stripes, metallic=np.full_like(ball.metallic, 257)), SKY)
    size = ball.size
    here = relit._at(np.float32([[1.5, 0.5], [2.0, 0.5], [2.25, 0.5]]) / np.float32(size))
    np.testing.assert_allclose(here.base[:, 0], [1.0, 0.5, 0.25], atol=1e-5)
    np.testing.assert_allclose(here.metallic[:, 0], 1 / 255, atol=1e-6)


def test_the_rays_of_a_lobe_may_be_shared_out() -> None:
    """From the ball's centre every ray meets the ball, whose light rises to one side."""
    relit = Relit(metal(20000), SKY)
    relit._sent[:] = np.float32(1) + relit.mesh.vertices[:, :1]
    up = np.tile(np.float32([[0, 0.6, 0.8]]), (5, 1))
    dark, rough = np.zeros((5, 3), np.float32), np.full(5, 0.5, np.float32)
    centre = np.tile(np.float32([[0, 0, 1]]), (5, 1))
    whole, *halves = (
        relit._blunted(dark, dark, centre, up, up, rough, lobe)
        for lobe in (range(8), range(0, 8, 2), range(1, 8, 2))
    )
    assert np.abs(halves[0] - halves[1]).max() > 0.01 and whole.min() > 0.5
    np.testing.assert_allclose(np.mean(halves, axis=0), whole, atol=1e-5)
