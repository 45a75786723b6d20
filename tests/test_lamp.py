"""A small lamp, against the laws that it follows."""

import numpy as np
import pytest

from refdgs_pipe.lamp import Lamp

UP = np.float32([[0, 0, 1]])
HERE = np.zeros((1, 3), np.float32)


def above(height: float, room: float = 0.0) -> Lamp:
    return Lamp(np.float32([0, 0, height]), 2.0, 0.7, room)


def test_at_its_distance_a_white_surface_is_as_bright_as_said() -> None:
    assert above(2.0, room=0.3).received(HERE, UP)[0, 0] == pytest.approx(0.7)


def test_light_falls_with_the_squared_distance_and_the_room_s_stays() -> None:
    assert above(4.0).received(HERE, UP)[0, 0] == pytest.approx(0.7 / 4)
    expected = 0.7 * (0.2 + 0.8 / 4)
    assert above(4.0, room=0.2).received(HERE, UP)[0, 0] == pytest.approx(expected)


def test_what_faces_away_gets_the_room_s_light_alone() -> None:
    assert above(2.0, room=0.25).received(HERE, -UP)[0, 0] == pytest.approx(0.7 * 0.25)


def test_a_highlight_sends_no_more_than_the_lamp_sheds() -> None:
    """The highlight's radiance over the half sphere, weighted by the cosine, is its reflectance."""
    rng = np.random.default_rng(0)
    z = rng.random(200_000)
    a = rng.random(len(z)) * 2 * np.pi
    level = np.sqrt(1 - z**2)
    toward = np.column_stack([level * np.cos(a), level * np.sin(a), z]).astype(np.float32)
    many = np.repeat(HERE, len(z), 0), np.repeat(UP, len(z), 0)
    f0 = np.ones((len(z), 3), np.float32)
    for roughness, least in ((0.4, 0.85), (0.7, 0.6)):  # what scatters twice is left out
        rough = np.full((len(z), 1), roughness, np.float32)
        sent = above(2.0).mirrored(*many, toward, f0, rough)[:, 0]
        share = 2 * np.pi * float((sent * z).mean()) / (np.pi * 0.7)
        assert least < share < 1.02


def test_a_rougher_surface_has_a_wider_and_weaker_highlight() -> None:
    f0 = np.ones((1, 3), np.float32)
    aside = np.float32([[0.5, 0, 0.866]])

    def sent(roughness: float, toward: np.ndarray) -> float:
        rough = np.full((1, 1), roughness, np.float32)
        return float(above(2.0).mirrored(HERE, UP, toward, f0, rough)[0, 0])

    assert sent(0.2, UP) > sent(0.6, UP)
    assert sent(0.2, aside) < sent(0.6, aside)
