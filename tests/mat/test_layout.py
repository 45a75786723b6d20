"""The mat on paper: where things are, and that the PDF and the picture are the same sheet."""

import re
import zlib
from functools import cache
from itertools import combinations

import cv2
import numpy as np
import pytest

from refdgs_pipe.mat.design import QUIET, black_cells, leaves, ruler
from refdgs_pipe.mat.drawing import pdf, picture
from refdgs_pipe.mat.layout import LINE_MM, Paper, mat_of

PAPERS: tuple[Paper, ...] = ("a4", "letter")


@cache
def printed(paper: Paper) -> bytes:
    """The PDF; it takes a while to draw."""
    return pdf(mat_of(paper))


@pytest.mark.parametrize("paper", PAPERS)
def test_markers_lie_inside_the_printable_area_and_leave_each_other_white(paper: Paper) -> None:
    mat = mat_of(paper)
    for one, other in combinations(mat.markers, 2):
        apart = max(abs(one.x - other.x), abs(one.y - other.y))
        assert apart >= (one.side + other.side) / 2 + QUIET
    for marker in mat.markers:
        for place, size in ((marker.x, mat.width), (marker.y, mat.height)):
            assert (
                place - marker.side / 2 + 1e-9 >= 9 and place + marker.side / 2 <= size - 9 + 1e-9
            )


def test_a_photo_tells_which_paper_it_shows() -> None:
    ids = [{marker.id for marker in mat_of(paper).markers} for paper in PAPERS]
    assert not ids[0] & ids[1]


def test_the_middle_is_free_for_the_object() -> None:
    for paper in PAPERS:
        mat = mat_of(paper)
        for marker in mat.markers:
            away = max(abs(marker.x - mat.width / 2), abs(marker.y - mat.height / 2))
            assert away - marker.side / 2 > 40  # mm


def test_the_ruler_line_covers_no_marker() -> None:
    mat = mat_of("letter")
    for box in ruler(mat):
        for marker in mat.markers:
            apart_x = max(box.left - marker.x, marker.x - box.right)
            apart_y = max(box.low - marker.y, marker.y - box.top)
            assert max(apart_x, apart_y) > marker.side / 2


def test_a_measured_line_stretches_the_whole_mat() -> None:
    plain, printed = mat_of("a4").corners(), mat_of("a4", line_mm=0.97 * LINE_MM).corners()
    assert np.allclose(printed[3], 0.97 * plain[3])


@pytest.mark.parametrize("paper", PAPERS)
def test_the_picture_shows_the_markers_where_the_layout_says(paper: Paper) -> None:
    mat, per_mm = mat_of(paper), 4.0
    grey = picture(mat, per_mm)
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_MIP_36h12)
    quads, ids, _ = cv2.aruco.ArucoDetector(book).detectMarkers(grey)
    assert sorted(np.ravel(ids)) == [marker.id for marker in mat.markers]
    corners = mat.corners()
    for quad, number in zip(quads, np.ravel(ids), strict=True):
        x, y = quad[0, :, 0] + 0.5, quad[0, :, 1] + 0.5
        where = np.stack([x / per_mm - mat.width / 2, mat.height / 2 - y / per_mm], 1)
        assert (
            np.abs(where - 1e3 * corners[int(number)][:, :2]).max() < 0.4
        )  # mm, a pixel and a half


def test_equal_mats_are_drawn_alike() -> None:
    first, second = leaves(mat_of("a4")), leaves(mat_of("a4"))
    assert all(np.array_equal(a.outline, b.outline) for a, b in zip(first, second, strict=True))
    assert pdf(mat_of("a4")) == printed("a4")


@pytest.mark.parametrize("paper", PAPERS)
def test_the_pdf_is_one_page_of_the_papers_size_with_every_marker(paper: Paper) -> None:
    mat = mat_of(paper)
    data = printed(paper)
    width, height = map(float, re.search(rb"MediaBox \[0 0 (\S+) (\S+)\]", data).groups())  # type: ignore[union-attr]
    assert np.allclose(np.array([width, height]) / 72 * 25.4, [mat.width, mat.height], atol=1e-3)
    page = zlib.decompress(data.partition(b"stream\n")[2].partition(b"\nendstream")[0]).decode()
    scale, paths = float(page.split()[0]), page.splitlines()
    assert scale == pytest.approx(72 / 25.4)  # the page is drawn in millimetres
    black = [line for line in paths if line.startswith("0 g")]
    drawn = [sorted(map(float, re.findall(r"(\S+) \S+ \S+ \S+ re", line))) for line in black]
    wanted = [sorted(box.left for box in boxes) for boxes in [*black_cells(mat), ruler(mat)]]
    assert all(np.allclose(a, b, atol=1e-3) for a, b in zip(drawn, wanted, strict=True))
    assert f"{LINE_MM:g} mm" in page


def test_the_pdf_points_to_its_own_objects() -> None:
    data = printed("a4")
    start = int(data.split(b"startxref\n")[1].split()[0])
    assert data[start : start + 4] == b"xref"
    places = [int(line[:10]) for line in data[start:].splitlines()[3:8]]
    assert [data[p:].split(b" ", 1)[0] for p in places] == [b"1", b"2", b"3", b"4", b"5"]


def test_nothing_is_drawn_where_printers_cannot_print() -> None:
    mat = mat_of("a4")
    grey = picture(mat, 4.0)
    edge = 5 * 4
    rim = np.concatenate([grey[:edge].ravel(), grey[-edge:].ravel(), grey[:, :edge].ravel()])
    assert rim.min() == 255
