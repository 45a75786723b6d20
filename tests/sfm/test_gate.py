"""A placement is judged by its evidence: what is right passes, what is wrong is refused."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from captures import Stages, looking, write_photos

from refdgs_pipe.artifacts.placement import Attempt, Evidence, Placement, Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.errors import CorruptError, PoseError
from refdgs_pipe.sfm.alike import Agreement
from refdgs_pipe.sfm.gaps import gaps_of, lowest_height
from refdgs_pipe.sfm.gate import check_trusted, examine
from refdgs_pipe.sfm.trust import deviation

COUNT, POINTS, SIDE, FOCAL = 12, 400, 64, 80.0
SHARED_FEATURES = "features shared by photos with nearly the same place"


def ring(turns: list[float], distance: float = 4.0) -> list[F64]:
    return [
        distance * np.array([np.cos(a) * 0.9, np.sin(a) * 0.9, 0.43])
        for a in np.radians(np.array(turns))
    ]


def placement(centers: list[F64], points: F64 | None = None, agree: float = 0.95) -> Placement:
    """Photos at these places that all see points near the origin."""
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 0.35, (POINTS, 3)) if points is None else points
    files = [f"IMG_{i}.png" for i in range(len(centers))]
    tracks = {f: np.sort(rng.choice(len(xyz), len(xyz) // 2, replace=False)) for f in files}
    names = tuple(sorted(files))
    pairs = np.array([(a, b) for a in range(len(files)) for b in range(a + 1, len(files))])
    shared = [len(np.intersect1d(tracks[names[a]], tracks[names[b]])) for a, b in pairs]
    many = len(pairs)
    evidence = Evidence(
        names=names,
        features=np.full(len(files), 900, np.int32),
        still=np.zeros(len(files)),
        moves=np.full(len(files), 0.001),
        pairs=pairs.astype(np.int32),
        matches=np.full(many, 120, np.int32),
        inliers=np.full(many, 90, np.int32),
        agree=np.full(many, agree),
        shared=np.array(shared, np.int32),
        held=np.arange(many) % 8 == 4,
        angle=np.full(many, 20.0),
    )
    lens = ("SIMPLE_RADIAL", SIDE, 48, np.array([FOCAL, SIDE / 2, 24.0, 0.0]))
    colors = np.full((len(xyz), 3), 128, np.uint8)
    poses = Poses(
        {f: looking(c) for f, c in zip(files, centers, strict=True)},
        dict.fromkeys(files, 0),
        (lens,),
        xyz,
        colors,
        {f: t.astype(np.int64) for f, t in tracks.items()},
        0.4,
        "incremental",
        evidence,
    )
    return Placement(poses, (Attempt("features as set", len(files), len(files), len(xyz)),))


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    folder = tmp_path_factory.mktemp("photos")
    write_photos(folder, COUNT, "png")
    return Stages(tmp_path_factory.mktemp("stages")).ingest(folder)


EVENLY = ring([30.0 * i for i in range(COUNT)])
IN_PAIRS = ring([60.0 * (i // 2) + 4.0 * (i % 2) for i in range(COUNT)])


def with_evidence(found: Placement, **changes: np.ndarray) -> Placement:
    assert found.poses is not None and found.poses.evidence is not None
    evidence = replace(found.poses.evidence, **changes)
    return replace(found, poses=replace(found.poses, evidence=evidence))


def test_photos_all_round_an_object_pass(views: Views) -> None:
    judgement = examine(views, placement(EVENLY), least=0.7)
    assert judgement.is_trusted and not judgement.lost
    assert not any("a gap" in text for text in judgement.gaps)
    assert len(check_trusted(views, judgement, attempts=1).cameras) == COUNT


@pytest.mark.parametrize(
    ("shared", "moves", "word"),
    [(20, 0.001, "82% of what"), (60, 0.015, "60% of what"), (60, 0.001, "")],
)
def test_one_photo_that_its_matches_contradict_is_left_out_by_name(
    views: Views, shared: int, moves: float, word: str
) -> None:
    """Unless many points hold its place, the other photos confirm it, and less speaks against."""
    found = placement(EVENLY)
    assert found.poses is not None and found.poses.evidence is not None
    evidence = found.poses.evidence
    row = evidence.names.index("IMG_3.png")
    mine = (evidence.pairs == row).any(1)
    changes = {
        "agree": np.where(mine, 0.0, evidence.agree),
        "shared": np.where(mine, shared, evidence.shared),
        "moves": np.where(np.arange(COUNT) == row, moves, evidence.moves),
    }
    judgement = examine(views, with_evidence(found, **changes), least=0.7)
    assert list(judgement.lost) == (["IMG_3"] if word else [])
    assert all(word in why for why in judgement.lost.values())
    assert judgement.is_trusted
    assert judgement.model is not None
    assert len(judgement.model.cameras) == COUNT - len(judgement.lost)


def test_places_that_most_matches_contradict_are_refused(views: Views) -> None:
    judgement = examine(views, placement(EVENLY, agree=0.35), least=0.7)
    assert not judgement.is_trusted
    with pytest.raises(PoseError, match=r"(?s)contradict the places: 65%.*Something repeats"):
        check_trusted(views, judgement, attempts=2)


def test_points_that_lie_elsewhere_are_refused(views: Views) -> None:
    """Copies and empty tables: cameras look at a place where nothing was found."""
    rng = np.random.default_rng(1)
    around = rng.normal(0, 1, (POINTS, 3))
    far = around / np.linalg.norm(around, axis=1, keepdims=True) * 9
    judgement = examine(views, placement(EVENLY, points=far), least=0.7)
    assert not judgement.is_trusted
    with pytest.raises(PoseError, match="points on and near the object: 0"):
        check_trusted(views, judgement, attempts=1)


def test_a_camera_that_hardly_moves_is_refused(views: Views) -> None:
    together = ring([0.2 * i for i in range(COUNT)])
    judgement = examine(views, placement(together), least=0.7)
    assert not judgement.is_trusted
    assert any("nearly the same place" in c.advice for c in judgement.checks if not c.is_met)


@pytest.mark.parametrize(("farther", "is_asked"), [(1.0, True), (1.8, False)])
def test_photos_of_one_direction_share_features_if_they_are_as_far(
    views: Views, farther: float, is_asked: bool
) -> None:
    """A close-up shows another part, and finer: it shares fewer features with its neighbours."""
    centers = [c * (farther if i % 2 else 1.0) for i, c in enumerate(IN_PAIRS)]
    assert (SHARED_FEATURES in _refused_where_close_photos_share_little(views, centers)) == is_asked


def test_photos_of_different_sides_that_share_a_far_wall_need_not_share_more(views: Views) -> None:
    """Their rays to the wall are nearly parallel, as those of photos from one place are."""
    assert SHARED_FEATURES not in _refused_where_close_photos_share_little(views, EVENLY)


def _refused_where_close_photos_share_little(views: Views, centers: list[F64]) -> list[str]:
    """Checks that fail if the rays of photos that follow each other are nearly parallel."""
    found = placement(centers)
    assert found.poses is not None and found.poses.evidence is not None
    a, b = found.poses.evidence.pairs.T
    rows = np.array([int(name[4:-4]) for name in found.poses.evidence.names])
    close = np.abs(rows[a] - rows[b]) == 1
    angle, few = np.where(close, 5.0, 20.0), np.where(close, 20, 90).astype(np.int32)
    judgement = examine(views, with_evidence(found, angle=angle, inliers=few), least=0.7)
    return [c.name for c in judgement.checks if not c.is_met]


def test_a_camera_at_another_scale_is_left_out(views: Views) -> None:
    centers = [*EVENLY[:-1], EVENLY[-1] * 9]
    judgement = examine(views, placement(centers), least=0.7)
    assert "times farther away" in judgement.lost[f"IMG_{COUNT - 1}"]


def test_two_groups_without_common_points_leave_the_smaller_out(views: Views) -> None:
    found = placement(EVENLY)
    assert found.poses is not None and found.poses.evidence is not None
    evidence = found.poses.evidence
    apart = {evidence.names.index(f"IMG_{i}.png") for i in range(3)}
    crossing = np.array([(a in apart) != (b in apart) for a, b in evidence.pairs])
    shared = np.where(crossing, 7, evidence.shared)
    judgement = examine(views, with_evidence(found, shared=shared), least=0.7)
    assert set(judgement.lost) == {"IMG_0", "IMG_1", "IMG_2"}
    assert "fewer than 10 points" in judgement.lost["IMG_0"]


def test_too_few_places_name_reasons_gaps_and_advice(views: Views) -> None:
    found = placement(ring([0, 20, 40, 60, 80]))
    judgement = examine(views, found, least=0.7)
    with pytest.raises(PoseError) as caught:
        check_trusted(views, judgement, attempts=3)
    text = str(caught.value)
    assert "only 5 of 12 photos found a place that can be trusted (3 ways" in text
    assert "IMG_9.png: " in text and "Take more photos" in text
    assert "between IMG_4.png and IMG_0.png there is a gap of 280 degrees" in text
    assert caught.value.exit_code == 66


def test_nothing_placed_is_refused_with_a_reason_for_each(views: Views) -> None:
    judgement = examine(views, Placement(None), least=0.7)
    assert judgement.model is None and len(judgement.lost) == COUNT
    with pytest.raises(PoseError, match="only 0 of 12"):
        check_trusted(views, judgement, attempts=3)


def test_a_ground_that_repeats_is_named_as_the_cause(views: Views) -> None:
    judgement = examine(views, Placement(None, repeats=True), least=0.7)
    with pytest.raises(PoseError, match=r"The ground seems to repeat .* newspaper"):
        check_trusted(views, judgement, attempts=3)


def test_gaps_name_the_photos_on_both_sides(views: Views) -> None:
    judgement = examine(views, placement(ring([25.0 * i for i in range(COUNT)])), least=0.7)
    assert judgement.model is not None
    names = {f"IMG_{i}": f"IMG_{i}.png" for i in range(COUNT)}
    said, _ = gaps_of(judgement.model, names)  # and all are from one height
    assert said == "between IMG_11.png and IMG_0.png there is a gap of 85 degrees"


@pytest.mark.parametrize(
    ("heights", "said"),
    [
        ((40.0, 60.0), "all photos look down from 40 degrees or more"),
        ((10.0, 25.0), "no photo looks down from more than 25 degrees"),
        ((10.0, 60.0), None),
    ],
)
def test_heights_that_no_photo_was_taken_from_are_named(
    heights: tuple[float, float], said: str | None
) -> None:
    angles = np.radians(30.0 * np.arange(12))
    tilts = np.radians(np.resize(heights, 12))
    places = np.stack(
        [np.cos(tilts) * np.cos(angles), np.cos(tilts) * np.sin(angles), np.sin(tilts)], 1
    )
    cameras = [SimpleNamespace(name=f"{i}", center=3 * at) for i, at in enumerate(places)]
    ball = SimpleNamespace(center=np.zeros(3))
    model = SimpleNamespace(cameras=cameras, ball=ball, up=np.array([0.0, 0.0, 1.0]))
    names = {f"{i}": f"{i}.jpg" for i in range(12)}
    found = gaps_of(model, names)  # type: ignore[arg-type]
    assert [text.split(":")[0] for text in found] == ([] if said is None else [said])
    assert lowest_height(model) == pytest.approx(min(heights))  # type: ignore[arg-type]
    model.cameras = cameras[:4]  # they do not go round: up and down may mean nothing
    assert all("gap" in text for text in gaps_of(model, names))  # type: ignore[arg-type]
    assert lowest_height(model) is None  # type: ignore[arg-type]


def test_a_placement_is_the_same_after_a_round_trip(tmp_path: Path) -> None:
    found = replace(
        placement(EVENLY), notes=("said",), metres_per_unit=0.2, up=np.array([0, 0, 1.0])
    )
    found.save(tmp_path)
    read = Placement.load(tmp_path)
    assert read.attempts == found.attempts and read.notes == ("said",)
    assert found.poses is not None and read.poses is not None
    for file, pose in found.poses.cam_from_world.items():
        np.testing.assert_array_equal(read.poses.cam_from_world[file], pose)
        np.testing.assert_array_equal(read.poses.tracks[file], found.poses.tracks[file])
    assert read.poses.evidence is not None and found.poses.evidence is not None
    np.testing.assert_array_equal(read.poses.evidence.shared, found.poses.evidence.shared)
    (tmp_path / "placement.json").write_text("{}")
    with pytest.raises(CorruptError, match=r"placement\.json"):
        Placement.load(tmp_path)


def in_two_groups(found: Placement, *, shared: int, agree: float) -> Placement:
    """The last four photos share so many points with the others, who agree so far with them."""
    assert found.poses is not None and found.poses.evidence is not None
    evidence = found.poses.evidence
    across = (evidence.pairs < COUNT - 4).any(1) & (evidence.pairs >= COUNT - 4).any(1)
    return with_evidence(
        found,
        shared=np.where(across, shared, 200).astype(np.int32),
        agree=np.where(across, agree, 0.9),
    )


def test_a_group_that_the_others_contradict_is_left_out_by_name(views: Views) -> None:
    found = in_two_groups(placement(EVENLY), shared=30, agree=0.05)
    judgement = examine(views, found, least=0.6)
    assert found.poses is not None and found.poses.evidence is not None
    assert {f"{name}.png" for name in judgement.lost} == set(found.poses.evidence.names[-4:])
    assert all("95% of the matches between it and 3 others" in w for w in judgement.lost.values())
    assert judgement.is_trusted
    assert not examine(views, found, least=0.7).is_trusted


@pytest.mark.parametrize(("shared", "agree"), [(12, 0.6), (200, 0.8)])
def test_a_group_that_the_others_confirm_stays(views: Views, shared: int, agree: float) -> None:
    found = in_two_groups(placement(EVENLY), shared=shared, agree=agree)
    assert not examine(views, found, least=0.7).lost


def test_photos_in_one_place_that_share_little_are_refused(views: Views) -> None:
    found = placement(IN_PAIRS)
    assert found.poses is not None and found.poses.evidence is not None
    angle = np.full(len(found.poses.evidence.pairs), 4.0)
    for count, is_trusted in ((400, True), (40, False)):
        few = np.full(len(angle), count, np.int32)
        judgement = examine(views, with_evidence(found, angle=angle, inliers=few), least=0.7)
        assert judgement.is_trusted == is_trusted
    failed = [check for check in judgement.checks if not check.is_met]
    assert [check.found for check in failed] == ["4% in 6 pairs, 9% are needed"]


def test_a_place_that_the_other_photos_do_not_confirm_is_left_out(views: Views) -> None:
    moves = np.full(COUNT, 0.004)
    moves[[2, 5]] = 0.06, np.inf
    judgement = examine(views, with_evidence(placement(EVENLY), moves=moves), least=0.7)
    assert sorted(why.split("see ")[1] for why in judgement.lost.values()) == [
        "cannot be done",
        "moves it by 6% of its distance",
    ]


@pytest.mark.parametrize(
    ("seen", "named"),
    [
        (Agreement(9, 0.3, 0, float("nan"), 0, float("nan")), "points that look alike"),
        (Agreement(9, 0.8, 4, 0.2, 0, float("nan")), "difference in light"),
        (Agreement(9, 0.8, 4, 0.02, 4, 0.2), "look alike but are lit otherwise"),
    ],
)
def test_close_photos_that_do_not_show_the_same_end_the_run(
    views: Views, seen: Agreement, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refdgs_pipe.sfm.gate.agreement", lambda *_: seen)
    judgement = examine(views, placement(EVENLY), least=0.7)
    with pytest.raises(PoseError, match=f"{named}.*\n?.*Photos of different sides"):
        check_trusted(views, judgement, attempts=1)


def test_close_photos_that_show_the_same_pass(
    views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Agreement(9, 0.8, 4, 0.02, 4, 0.03)
    monkeypatch.setattr("refdgs_pipe.sfm.gate.agreement", lambda *_: seen)
    assert examine(views, placement(EVENLY), least=0.7).is_trusted


@pytest.mark.parametrize("trusted", [False, True])
def test_places_that_are_not_trusted_make_no_solution_contradict_another(trusted: bool) -> None:
    """Seven of twelve photos lie elsewhere in the second solution."""
    far = np.arange(COUNT) < 7
    moves = np.where(far & (not trusted), np.inf, 0.001)
    elsewhere = [
        place * [-2.0, 3.0, -1.0] if away else place
        for place, away in zip(EVENLY, far, strict=True)
    ]
    names = [f"IMG_{i}.png" for i in range(COUNT)]
    order = np.argsort(np.array(names))
    one, other = placement(EVENLY), with_evidence(placement(elsewhere), moves=moves[order])
    assert one.poses is not None and other.poses is not None
    apart = deviation(one.poses, other.poses)
    assert apart is not None and (apart > 0.1) == trusted


def test_points_that_only_a_photo_far_away_told_apart_go_with_it(views: Views) -> None:
    """Otherwise photos that see them seem to stand in one place."""
    rng = np.random.default_rng(2)
    far = np.array([3e5, 1e5, 0.0]) + rng.normal(0, 1.0, (40, 3))
    points = np.concatenate([rng.normal(0, 0.35, (POINTS, 3)), far])
    found = placement([*EVENLY[:-1], np.array([4e5, 1e5, 0.0])], points)
    stray = f"IMG_{COUNT - 1}.png"
    assert found.poses is not None and found.poses.evidence is not None
    moves = np.where(np.array(found.poses.evidence.names) == stray, np.inf, 0.001)
    judgement = examine(views, with_evidence(found, moves=moves), least=0.7)
    assert list(judgement.lost) == [stray.removesuffix(".png")]
    model = judgement.model
    assert model is not None and 0.9 * POINTS < len(model.points) <= POINTS
    assert np.linalg.norm(model.points - model.ball.center, axis=1).max() < 10
