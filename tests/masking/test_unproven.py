"""What lies below an object counts as the plane only if its texture proves it."""

import cv2
import numpy as np
import pytest
from boxes import BODY, GROUND, REACH, TABLE, WHITE, Box, N, cameras, shown

from refdgs_pipe.ground.shots import F32, Bools
from refdgs_pipe.masking.beyond import LEAST, _proof
from refdgs_pipe.masking.unproven import (
    LEAK,
    _misleading,
    below,
    proven,
    shown_from,
    unproven,
    without_ground,
)

# Its lower half has the mean colour of the table, as a blurred reflection of it has.
GREY: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.35), TABLE)
HEAD: Box = ((-0.4, -0.3, 0.35), (0.4, 0.3, 0.7), WHITE)
LOW: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.2), TABLE)
BELLY: Box = ((-0.4, -0.3, 0.2), (0.4, 0.3, 0.7), WHITE)
HUNG: Box = ((-0.3, -0.3, 0.5), (0.3, 0.3, 0.7), WHITE)


def found(seen: F32, *, glossy: bool = False) -> Bools:
    colour = np.asarray(np.median(seen, axis=0))
    towards = shown_from(colour, seen, GROUND, cameras())
    return unproven(colour, seen, GROUND, cameras(), 1.0, towards, glossy=glossy)


def inside() -> Bools:
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    return (np.abs(x) < 0.4) & (np.abs(y) < 0.3)


def test_a_foot_that_looks_like_the_plane_is_found_below_what_does_not() -> None:
    cells, true = found(shown([GREY, HEAD])), inside()
    assert (cells & true).sum() / (cells | true).sum() > 0.6


def test_where_photos_disagree_on_the_colour_nothing_is_found() -> None:
    seen = shown([LOW, BELLY])  # what hides the plane shows in most photos
    assert below(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)[inside()].mean() > 0.95
    assert not found(seen).any()


def test_a_place_whose_texture_some_photos_show_is_no_foot(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, eyes = shown([GREY, HEAD]), cameras()
    side = eyes[:, 0] > 0.5 * np.linalg.norm(eyes, axis=1)
    seen[side] = shown([])[side]
    assert not found(seen).any()
    monkeypatch.setattr("refdgs_pipe.masking.unproven.ONCE", 1.0)
    assert found(seen).any()


def test_on_a_glossy_ground_some_texture_does_not_speak_against_a_foot() -> None:
    seen, eyes = shown([GREY, HEAD]), cameras()
    side = eyes[:, 0] > 0.5 * np.linalg.norm(eyes, axis=1)
    x = np.flatnonzero(inside().any(0))
    third = np.zeros((N, N), bool)
    third[:, x[-len(x) // 3] :] = True
    seen[side] = np.where(third[..., None], shown([])[side], seen[side])
    assert not found(seen).any()
    assert (found(seen, glossy=True) & inside()).sum() > 0.5 * inside().sum()


def test_texture_at_the_edge_of_a_part_does_not_speak_against_a_foot() -> None:
    seen = shown([GREY, HEAD])
    colour = np.asarray(np.median(seen, axis=0))
    part = found(seen)
    core = cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) > LEAK
    assert (_misleading(part, colour, seen, part & ~core) == part).all()
    assert not _misleading(part, colour, seen, part).any()


def test_a_part_with_the_planes_texture_all_over_is_no_body() -> None:
    bodies, sure = np.zeros((2, 20, 20), bool)
    bodies[2:8, 2:8] = bodies[12:18, 12:18] = True
    sure[:10], sure[12:14] = True, True  # the plane's texture leaks into a third of a body
    kept = without_ground(bodies, sure)
    assert not kept[:10].any()
    np.testing.assert_array_equal(kept[10:], bodies[10:])


def test_nothing_is_found_on_an_empty_plane_nor_below_what_hangs_high() -> None:
    assert not found(shown([])).any()
    assert not found(shown([HUNG])).any()


def test_nothing_is_said_of_a_plane_without_texture() -> None:
    assert not found(shown([GREY, HEAD], contrast=0.0)).any()


def test_texture_is_a_proof_only_if_photos_from_two_sides_see_it() -> None:
    seen = shown([BODY])
    colour = np.median(seen, axis=0)
    far = proven(shown_from(colour, seen, GROUND, cameras()))[: N // 8]
    assert far.mean() > 0.8
    eyes = cameras()
    near = np.linalg.norm(eyes - eyes[0], axis=1) < 1.2
    assert not proven(shown_from(colour, seen[near], GROUND, eyes[near]))[: N // 8].any()


def test_cells_below_a_body_are_those_above_which_it_is_seen() -> None:
    seen = shown([HEAD, GREY])
    cells = below(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)
    assert cells[inside()].mean() > 0.95
    assert cells[:, : N // 4].mean() < 0.02


def test_likeness_without_texture_tells_little_beside_texture_and_all_in_a_plain_room() -> None:
    rng = np.random.default_rng(0)
    logs = rng.normal(0, 0.2, (40, 60, 3)).astype(np.float32)
    logs[:, 30:] = 0.3
    beside = np.ones((40, 60), bool)
    proof = _proof(logs, beside)
    assert np.median(proof[:, :25]) == 1 and proof[:, 40:].max() < LEAST + 0.05
    plain = rng.normal(0, 0.002, (40, 60, 3)).astype(np.float32)
    assert np.median(_proof(plain, beside)) > 0.8
