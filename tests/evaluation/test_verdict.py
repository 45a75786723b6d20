"""The verdict is as bad as the worst that was measured, says so in plain words, without truth."""

from dataclasses import replace

import finished
import numpy as np
import pytest
import solids
from scenes import Scene, Sphere, constant, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.evaluation.object_figures import (
    Witness,
    contradicted,
    object_pixels,
    outline_apart,
)
from refdgs_pipe.evaluation.verdict import judged
from refdgs_pipe.evaluation.wholeness import (
    hanging_share,
    height_above,
    loose_parts,
    open_holes,
)

UP = np.array([0.0, 0.0, 1.0])
FINE = replace(finished.FINE, photos=40, placed=40, masked=True, metres=True)
WORSE = {
    "psnr": (22.0, 10.0),
    "placed": (31, 10),
    "asset_psnr": (20.0, 10.0),
    "outline": (2.5, 20.0),
    "contradicted": (0.1, 0.6),
    "part_share": (0.03, 0.3),
    "floats": (0.05, 0.2),
    "hanging": (0.05, 0.4),
}


def test_a_result_that_nothing_speaks_against_is_good() -> None:
    found = judged(FINE)
    assert (found.word, found.line) == ("good", "good")
    assert {finding.word for finding in found.findings} == {"good"}
    assert not any(finding.advice for finding in found.findings)


@pytest.mark.parametrize("figure", WORSE)
def test_one_figure_decides_and_comes_first_with_advice(figure: str) -> None:
    scores = [judged(FINE).score]
    for value, word in zip(WORSE[figure], ("fair", "poor"), strict=True):
        both = {"training_psnr": value} if figure == "psnr" else {}
        found = judged(replace(FINE, **{figure: value}, **both))
        assert found.word == word and found.findings[0].word == word
        assert found.findings[0].advice
        scores.append(found.score)
    assert scores == sorted(scores, reverse=True) and len(set(scores)) == 3


def test_two_figures_that_are_nearly_poor_make_a_result_poor() -> None:
    weak = replace(FINE, psnr=18.0, training_psnr=18.0)
    assert judged(weak).word == "fair"  # one of them does not
    found = judged(replace(weak, seen=0.5, unseen=0.1))
    first, *others = found.findings
    assert found.word == first.word == "poor" and "poor" not in {f.word for f in others}
    assert first.value == ("surface whose shape is well known and sharpness against unseen photos")
    assert first.advice == others[0].advice and first.plain
    assert 0 < found.score < judged(weak).score


def test_findings_are_told_in_plain_words() -> None:
    found = judged(replace(FINE, psnr=24.0, training_psnr=24.0))
    assert found.findings[0].text == "sharpness against unseen photos: fair, 24 dB on the object"
    shape = judged(replace(FINE, seen=0.67, unseen=0.03)).findings[0]
    assert shape.plain == "The shape of some of the surface is a guess"
    assert shape.value == "67% is well known, nobody saw 3%"  # not: 67% is a guess
    assert (
        judged(replace(FINE, psnr=24.0, training_psnr=24.0), draft=True).line
        == "fair: a first look"
    )


def test_an_unknown_size_is_said_and_decides_nothing() -> None:
    found = judged(replace(FINE, metres=False))
    assert found.word == "good" and found.score == judged(FINE).score
    assert found.findings[-1].word is None and "size unknown" in found.findings[-1].value


def test_a_result_that_no_photo_shows_is_poor() -> None:
    lost = judged(ObjectFigures(photos=20, placed=20))
    assert lost.word == "poor" and lost.findings[0].value == "no photo shows it"


@pytest.mark.parametrize(
    "lowest, word", [(None, "good"), (14.0, "good"), (37.0, "fair"), (65.0, "poor")]
)
def test_photos_from_above_alone_are_not_enough(lowest: float | None, word: str) -> None:
    assert judged(replace(FINE, lowest=lowest)).word == word


def test_an_object_without_its_lower_part_floats() -> None:
    ball = solids.sphere(24, radius=1.0)
    stands = replace(ball, vertices=ball.vertices + np.array([0, 0, 1.0], np.float32))
    middle = stands.vertices[stands.faces].mean(1)[:, 2]
    upper = TriangleMesh(stands.vertices, stands.faces[middle > 1.0])
    assert height_above(stands, UP) < 0.02
    assert height_above(upper, UP) == pytest.approx(1 / 3, abs=0.02)  # 1 of 2 x 2 x 1


def balls(*places: tuple[float, float, float]) -> TriangleMesh:
    """Balls of radius 1 around places."""
    ball = solids.sphere(24, radius=1.0)
    points = [ball.vertices + np.array(place, np.float32) for place in places]
    faces = [ball.faces + i * len(ball.vertices) for i in range(len(places))]
    return TriangleMesh(np.concatenate(points), np.concatenate(faces).astype(np.int32))


@pytest.mark.parametrize(
    "places, share",
    [
        ([(0, 0, 1)], 0),
        ([(0, 0, 1), (4, 0, 1)], 0),  # both stand
        ([(0, 0, 1), (4, 0, 1), (0, 0, 3.02)], 0),  # one lies on another
        ([(0, 0, 1), (0, 0, 3.02), (0, 0, 5.04)], 0),
        ([(0, 0, 1), (0, 0, 4)], 1 / 2),
        ([(0, 0, 1), (0, 0, 5), (0, 0, 7.02)], 2 / 3),  # they hold each other only
        ([(0, 0, 5), (4, 0, 5)], 0),  # nothing is lower: another figure tells
    ],
)
def test_a_part_that_nothing_holds_is_found(
    places: list[tuple[float, float, float]], share: float
) -> None:
    assert hanging_share(balls(*places), UP) == pytest.approx(share, abs=1e-6)


def test_a_part_lies_on_a_plain_top_without_vertices_near_it() -> None:
    ball = balls((0, 0, 1.02))
    plate = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], np.float32)
    two = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    leg = plate / 3 + np.array([0, 0, -2], np.float32)
    both = TriangleMesh(
        np.concatenate([ball.vertices, plate, leg, leg + np.array([0, 0, 1.99], np.float32)]),
        np.concatenate([ball.faces, *(two + len(ball.vertices) + 4 * i for i in range(3))]),
    )
    assert hanging_share(both, UP) > 0.5  # the lowest plate is far below
    low = replace(both, faces=np.delete(both.faces, [-3, -4], axis=0))
    assert hanging_share(low, UP) == 0


def test_a_bottom_may_be_open_and_a_top_may_not() -> None:
    ball = solids.sphere(24, radius=1.0)
    middle = ball.vertices[ball.faces].mean(1)[:, 2]
    assert open_holes(ball, UP) == (0, 0.0)
    assert open_holes(TriangleMesh(ball.vertices, ball.faces[middle > -0.8]), UP) == (0, 0.0)
    count, length = open_holes(TriangleMesh(ball.vertices, ball.faces[middle < 0.8]), UP)
    # a rim near the circle of radius 0.6 that a plane at 0.8 cuts; it runs along edges
    assert count == 1 and 1.0 < length / (2 * np.pi * 0.6) < 1.6


def test_bits_that_hang_together_with_nothing_are_counted() -> None:
    ball, bit = solids.sphere(24, radius=1.0), solids.sphere(8, radius=0.1)
    apart = (bit.vertices + np.float32(3)).astype(np.float32)
    both = TriangleMesh(
        np.concatenate([ball.vertices, apart]),
        np.concatenate([ball.faces, bit.faces + len(ball.vertices)]).astype(np.int32),
    )
    assert loose_parts(ball) == (0, 0.0)
    count, share = loose_parts(both)
    assert count == 1 and share == pytest.approx(0.01, rel=0.15)  # areas as radii squared


def test_outlines_apart_are_told_in_parts_of_the_size() -> None:
    y, x = np.mgrid[0:200, 0:200]
    away, valid = np.hypot(x - 100, y - 100), np.ones((200, 200), bool)
    ring = outline_apart(away < 64, away < 60, valid)
    # 4 pixels of a disc whose area's root is 60 sqrt(pi); pixels round the edge are counted
    assert ring == pytest.approx(100 * 4 / (60 * np.pi**0.5), rel=0.2)
    assert outline_apart(away < 60, away < 60, valid) == 0
    assert outline_apart(away < 60, away < 0, valid) is None
    pixels = object_pixels(away < 20, away < 60)
    assert pixels[away < 61].all() and not pixels[away > 65].any()


def test_views_that_agree_contradict_nothing_and_a_floater_is_found() -> None:
    ball = Scene((Sphere((0.0, 0.0, 0.0), 0.8, constant(0.5, 0.5, 0.5)),), gradient_sky)
    maps = [ball.surface_map(camera) for camera in orbit(6, size=48, focal=60.0)]
    fine = contradicted(maps, 0.05)
    assert fine is not None and fine < 0.01
    nearer = replace(maps[0], depth=maps[0].depth * np.float32(0.6))
    bad = contradicted([nearer, *maps[1:]], 0.05)
    assert bad is not None and bad > fine + 0.1
    assert contradicted(maps[:1], 0.05) is None


def test_a_witness_tells_the_object_from_its_surroundings() -> None:
    scene = Scene((Sphere((0.0, 0.0, 0.0), 0.8, waves),), gradient_sky)
    mesh, witness = solids.sphere(48, radius=0.8), None
    witness = Witness(mesh)
    for camera in orbit(3, size=64, focal=90.0):
        maps: SurfaceMap = scene.surface_map(camera)
        backdrop = np.full((64, 64, 3), 0.2, np.float32)
        there = maps.alpha[..., None]
        photo = Photo(
            camera, maps.color * there + backdrop * (1 - there), None, np.ones((64, 64), bool)
        )
        wrong = np.where(there > 0, photo.rgb, np.float32(0.9))  # of the background alone
        object_psnr, asset_psnr = witness.look(photo, wrong, maps, photo.rgb)
        assert asset_psnr is not None and asset_psnr > 60
        assert object_psnr is not None and object_psnr > 8  # a margin of a pixel counts
        everywhere = -10 * np.log10(((wrong - photo.rgb) ** 2).mean())
        assert object_psnr > everywhere + 3
