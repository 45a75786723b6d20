"""The colour chart: found where there is one, corrected for, and never seen where there is none."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.files.images import read_png, write_png
from refdgs_pipe.imaging.chart import (
    ChartFix,
    apply_fix,
    chart_figures,
    corrected,
    fitted,
    fix_by_chart,
    patches_in,
    reference,
)
from refdgs_pipe.imaging.color_difference import F64, ciede2000, lab_from_linear

CAST = np.array([[0.75, 0.08, 0.02], [0.03, 0.6, 0.05], [0.01, 0.07, 0.38]])  # lamp and sensor


def chart(size: tuple[int, int] = (640, 480), patch: int = 50) -> F64:
    """A photo (H, W, 3) in linear light of a chart lying askew on a table."""
    gap = patch // 6
    flat = np.full((4 * (patch + gap) + gap, 6 * (patch + gap) + gap, 3), 0.03)
    for i, color in enumerate(np.clip(reference(), 0, 1)):
        y, x = gap + (i // 6) * (patch + gap), gap + (i % 6) * (patch + gap)
        flat[y : y + patch, x : x + patch] = color
    h, w = flat.shape[:2]
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    askew = corners * 0.9 + np.array([[140, 90], [150, 110], [120, 125], [125, 85]], np.float32)
    plane = cv2.getPerspectiveTransform(corners, askew)
    photo = np.full((size[1], size[0], 3), 0.35)
    moved = cv2.warpPerspective(flat, plane, size, flags=cv2.INTER_AREA)
    shown = cv2.warpPerspective(np.ones((h, w)), plane, size) > 0.5
    photo[shown] = moved[shown]
    noise = np.random.default_rng(0).normal(0, 0.003, photo.shape)
    return np.asarray(np.clip(cv2.GaussianBlur(photo, (0, 0), 0.8) + noise, 0, 1))


def photographed(linear: F64, *, bits: int, encoded: bool) -> np.ndarray:
    unit = srgb_from_linear(linear.astype(np.float32)) if encoded else linear
    full = 2**bits - 1
    return np.round(np.clip(unit, 0, 1) * full).astype(np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize(("bits", "encoded"), [(8, True), (16, False)])
def test_a_cast_is_found_and_taken_back(bits: int, encoded: bool) -> None:
    true = chart()
    photo = photographed(true @ CAST.T, bits=bits, encoded=encoded)
    patches = patches_in(photo, linear=not encoded)
    assert patches is not None
    fix = fitted(patches, "a.png")
    assert fix is not None and fix.before > 8 and fix.after < 1.5 and fix.patches >= 18
    right = CAST @ fix.matrix  # unity up to brightness
    assert np.abs(right / right[1, 1] - np.eye(3)).max() < 0.06
    back = corrected(photo, fix, linear=not encoded)
    assert back.dtype == photo.dtype and back.shape == photo.shape
    grey = back[5:40, 5:40].reshape(-1, 3).mean(axis=0) / np.iinfo(back.dtype).max
    assert np.ptp(grey) < 0.01  # the table was grey


def test_brightness_stays() -> None:
    patches = 0.5 * reference()
    fix = fitted(patches)
    assert fix is not None
    assert np.allclose(fix.matrix, np.eye(3), atol=0.02) and fix.before < 0.5


def test_what_is_no_chart_is_not_taken_for_one() -> None:
    draw = np.random.default_rng(4)
    for _ in range(20):
        assert fitted(draw.uniform(0.05, 0.9, (24, 3))) is None
    assert fitted(np.full((24, 3), 0.4)) is None
    shuffled = reference()[draw.permutation(24)]
    assert fitted(shuffled) is None
    for seed in range(3):
        noise = np.random.default_rng(seed).integers(0, 255, (12, 16, 3), np.uint8)
        blocks = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_NEAREST)
        patches = patches_in(np.asarray(blocks, np.uint8), linear=False)
        assert patches is None or fitted(patches) is None
    assert patches_in(np.zeros((1, 1, 3), np.uint8), linear=False) is None


def test_clipped_patches_do_not_count() -> None:
    bright = np.clip(1.4 * reference(), 0, 1)
    fix = fitted(bright)
    assert fix is not None and fix.patches < 24 and fix.after < 1.0


def test_the_whole_set_is_corrected_by_the_one_photo_with_a_chart(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", photographed(chart() @ CAST.T, bits=8, encoded=True))
    plain = np.full((40, 50, 3), 0.2) @ CAST.T
    write_png(tmp_path / "b.png", photographed(plain, bits=8, encoded=True))
    fix = fix_by_chart(tmp_path, ["a.png", "b.png"], linear=False)
    assert isinstance(fix, ChartFix) and fix.photo == "a.png"
    apply_fix(fix, tmp_path, ["b.png"], linear=False)
    now = linear_from_srgb(read_png(tmp_path / "b.png").astype(np.float32) / 255)
    assert np.ptp(now.reshape(-1, 3).mean(axis=0)) < 0.01
    assert fix_by_chart(tmp_path, ["b.png"], linear=False) is None


def test_the_difference_is_that_of_the_published_pairs() -> None:
    """Sharma, Wu, Dalal (2005), table 1: pairs 1, 7, 9, 13, 17, 25 and 34."""
    one = [
        (50, 2.6772, -79.7751),
        (50, 0, 0),
        (50, 2.49, -0.001),
        (50, -0.001, 2.49),
        (50, 2.5, 0),
        (60.2574, -34.0099, 36.2677),
        (2.0776, 0.0795, -1.135),
    ]
    other = [
        (50, 0, -82.7485),
        (50, -1, 2),
        (50, -2.49, 0.0009),
        (50, 0.0009, -2.49),
        (73, 25, -18),
        (60.4626, -34.1751, 39.4387),
        (0.9033, -0.0636, -0.5514),
    ]
    wanted = [2.0425, 2.3669, 7.1792, 4.8045, 27.1492, 1.2644, 0.9082]
    assert np.allclose(ciede2000(np.array(one), np.array(other)), wanted, atol=1e-4)


def test_lab_of_white_and_grey() -> None:
    lab = lab_from_linear(np.array([[1.0, 1, 1], [0.18418, 0.18418, 0.18418], [0, 0, 0]]))
    assert np.allclose(lab, [[100, 0, 0], [50, 0, 0], [0, 0, 0]], atol=1e-2)


def test_views_are_corrected_unless_told_not_to(tmp_path: Path) -> None:
    names = ("a", "b")
    write_png(tmp_path / "images" / "a.png", photographed(chart() @ CAST.T, bits=8, encoded=True))
    plain = photographed(np.full((40, 50, 3), 0.2) @ CAST.T, bits=8, encoded=True)
    write_png(tmp_path / "images" / "b.png", plain)
    items = tuple(
        View(n, f"images/{n}.png", 0, 0, None, "train", Exif(), 0, 0, None, f"{n}.jpg")
        for n in names
    )
    views = Views(tmp_path, items, "srgb", "photo")
    assert chart_figures(views, "off") == {}
    assert chart_figures(replace(views, background="removed"), "auto") == {}
    assert np.array_equal(read_png(tmp_path / "images" / "b.png"), plain)
    told = chart_figures(views, "auto")["colour chart"]
    assert "in a.jpg" in str(told) and "after" in str(told)
    now = read_png(tmp_path / "images" / "b.png").astype(int)
    assert np.ptp(now.reshape(-1, 3).mean(axis=0)) < 3 < np.ptp(plain.reshape(-1, 3).mean(axis=0))
