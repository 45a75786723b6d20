"""Results of known quality get the scores that they deserve."""

import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import solids
import truth as scenes
from captures import Stages
from oracle import RADIUS, Oracle, moved, turned, write_ball

from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.truth import view_truth_files
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.evaluation.scoring import Drawing, Protocol, Subject, score
from refdgs_pipe.evaluation.speed import Timed
from refdgs_pipe.evaluation.surface import Surface
from refdgs_pipe.evaluation.truth import read_view_truth


def blurred(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.float32)


@pytest.fixture(scope="module")
def read_once(tmp_path_factory: pytest.TempPathFactory) -> Oracle:
    folder = tmp_path_factory.mktemp("ball")
    (folder / "stages").mkdir()
    return Oracle(write_ball(folder / "ball"), Stages(folder / "stages"))


@pytest.fixture
def ball(read_once: Oracle, tmp_path: Path) -> Oracle:
    """With files of its own, to be damaged."""
    own = copy.copy(read_once)
    own.root = tmp_path / "ball"
    shutil.copytree(read_once.root, own.root)
    return own


def check_perfect(scores: Scores) -> None:
    assert scores.split == "test"
    for view in scores.views:
        assert view.psnr > 60 and view.psnr_per_channel > 60
        assert view.ssim > 0.9999
        assert view.normal_mae_deg == pytest.approx(0, abs=1e-4)  # float32 unit vectors
        assert view.normal_mae_foreground_deg == pytest.approx(0, abs=1e-4)
        assert view.depth_mae == 0
        assert view.alpha_iou is not None and view.alpha_iou > 0.985  # box filter or pixel centre
    surface = scores.surface
    assert surface is not None and surface.chamfer is not None
    assert surface.paper_chamfer == 0 and surface.chamfer < 1e-6
    assert surface.f_score_half_percent == surface.f_score_one_percent == 1
    assert set(scores.notes) == {"lpips", "materials", "relit_psnr", "relit_object_psnr"}


def check_known_errors(oracle: Oracle) -> None:
    """Normals turned by 5 degrees, blurred pictures, depths 1 % too large."""
    scores = oracle.score(
        maps=lambda maps: replace(turned(maps, 5), depth=maps.depth * np.float32(1.01)),
        picture=blurred,
    )
    assert scores.mean("normal_mae_foreground_deg") == pytest.approx(5, abs=1e-3)
    for view in scores.views:
        files = view_truth_files(oracle.root / oracle.views[view.name].source)
        truth = read_view_truth(files)
        assert truth.foreground is not None and truth.depth is not None
        share = truth.foreground.mean()
        assert view.normal_mae_deg == pytest.approx(5 * share, abs=1e-3)
        there = (truth.depth > 0) & truth.foreground
        assert view.depth_mae == pytest.approx(0.01 * truth.depth[there].mean(), rel=1e-3)
        sharp = oracle.picture(next(c for c in oracle.model.cameras if c.name == view.name))
        error = np.mean((blurred(sharp).astype(np.float64) - sharp) ** 2)
        assert view.psnr == pytest.approx(-10 * np.log10(error), abs=1e-3)
        assert view.psnr_per_channel >= view.psnr


def check_a_shift_by_one_percent(oracle: Oracle) -> None:
    """Every true point is then as far from the surface as the surface is from it, moved back."""
    step = (0.0, 0.0, 0.01 * oracle.diagonal)
    surface = oracle.score_surface(mesh=moved(oracle.mesh, step))
    cameras = [camera for camera in oracle.model.cameras if camera.split == "train"]
    points = Surface(oracle.mesh, cameras).seen_samples(20_000, seed=7)
    there, back = (
        scenes.distances(points + np.array(way), oracle.mesh.vertices, oracle.mesh.faces).mean()
        for way in (step, tuple(-s for s in step))
    )
    assert surface.percent(surface.chamfer) == pytest.approx(
        100 * (there + back) / 2 / oracle.diagonal, rel=0.03
    )  # other samples, and the rim of what is seen
    assert surface.paper_chamfer is not None
    assert 0 < surface.paper_chamfer < step[2] + 0.01


def test_the_truth_of_a_ball_scored_as_a_result_is_perfect(ball: Oracle) -> None:
    check_perfect(ball.score())


def test_known_errors_of_a_ball_are_found(ball: Oracle) -> None:
    check_known_errors(ball)
    assert ball.diagonal == pytest.approx(2 * RADIUS * 3**0.5, rel=1e-3)
    check_a_shift_by_one_percent(ball)
    surface = ball.score_surface(mesh=moved(ball.mesh, (0.01 * ball.diagonal, 0, 0)))
    assert surface.percent(surface.chamfer) == pytest.approx(0.5, rel=0.03)  # mean of |cos|


def test_a_lump_far_off_counts_unless_the_mesh_may_hold_a_table(ball: Oracle) -> None:
    """Of photos without poses, whose truth lies where its cameras do."""
    lump = moved(replace(ball.mesh, vertices=ball.mesh.vertices / 4), (1.4 * RADIUS, 0, 0))
    mesh = solids.joined(ball.mesh, lump)
    frames = [
        {"file": f"{camera.name}.png", "transform_matrix": camera.world_from_cam.tolist()}
        for camera in ball.model.cameras
    ]
    (ball.root / "cameras_gt.json").write_text(json.dumps({"frames": frames}))
    model = replace(ball.model, sfm_from_world=np.diag([2.0, 2.0, 2.0, 1.0]))
    drawing = Drawing(ball.picture, ball.maps)
    surfaces = []
    for background in ("white", "photo"):
        views = replace(ball.views, background=background)
        subject = Subject(views, model, mesh, ball.root)
        surfaces.append(score(subject, drawing, Protocol(800)).surface)
    masked, among = surfaces
    assert masked is not None and masked.accuracy is not None
    assert among is not None and among.accuracy is not None and among.left_out is not None
    assert masked.left_out is None and masked.accuracy > 0.005 * ball.diagonal
    assert 0.03 < among.left_out < 0.12 and among.accuracy < 0.25 * masked.accuracy
    assert masked.paper_chamfer is None and among.paper_chamfer is None


def test_scores_are_the_same_after_a_round_trip(ball: Oracle, tmp_path: Path) -> None:
    scores = ball.score(protocol=Protocol(800, lpips=lambda a, b: float(np.abs(a - b).mean())))
    assert scores.mean("lpips") == pytest.approx(0, abs=1e-6)
    scores.save(tmp_path)
    assert Scores.load(tmp_path) == scores
    (tmp_path / "scores.json").write_text("{}")
    with pytest.raises(CorruptError, match=r"scores\.json"):
        Scores.load(tmp_path)


def test_smaller_pictures_are_compared_with_whole_truth(ball: Oracle) -> None:
    """The true maps are not resampled: the result is drawn at their size."""
    half = ball.score(picture=lambda image: image[::2, ::2], protocol=Protocol(32))
    assert half.psnr > 20
    assert half.mean("normal_mae_deg") == pytest.approx(0, abs=1e-4)


def test_coverage_alone_is_compared_no_larger_than_pictures(ball: Oracle) -> None:
    """Large photos with an alpha channel need no large drawings."""
    for path in ball.root.glob("*/r_*_*"):
        path.unlink()
    sizes = set[int]()

    def half(maps: SurfaceMap) -> SurfaceMap:
        sizes.add(maps.camera.width)
        return replace(maps, alpha=np.ones((32, 32), np.float32))

    scores = ball.score(picture=lambda image: image[::2, ::2], maps=half, protocol=Protocol(32))
    assert sizes == {32}
    disc = np.pi * (RADIUS / 4) ** 2 * 1.4**2 / (1 - (RADIUS / 4) ** 2)  # of a picture of size 1
    assert scores.mean("alpha_iou") == pytest.approx(disc, rel=0.03)
    assert scores.notes["depth_mae"] == "no NAME_depth.npz beside the photos"


def test_what_is_missing_is_not_scored_and_says_why(ball: Oracle) -> None:
    scores = ball.score()
    assert scores.notes["lpips"] == "no weights given (--lpips-weights)"
    assert set(scores.notes) == {"lpips", "materials", "relit_psnr", "relit_object_psnr"}
    (ball.root / "test" / "r_3_depth.npz").unlink()
    (ball.root / "gt_mesh.ply").unlink()
    scores = ball.score()
    assert scores.surface is None
    assert scores.notes["surface"] == "no gt_mesh.ply in the data set"
    assert scores.notes["depth_mae"] == "3 of 4 views have a NAME_depth.npz"
    assert scores.mean("depth_mae") == 0


def test_photos_without_poses_of_their_own_have_no_truth(ball: Oracle) -> None:
    turned_world = np.diag([2.0, 2.0, 2.0, 1.0])
    ball.model = replace(ball.model, sfm_from_world=turned_world)
    scores = ball.score()
    assert scores.surface is None
    assert scores.mean("normal_mae_deg") is None and scores.psnr > 60
    assert "without poses" in scores.notes["surface"]
    assert "without poses" in scores.notes["normal_mae_deg"]


def test_photos_through_a_bent_lens_have_a_true_surface_but_no_true_maps(ball: Oracle) -> None:
    bent = {
        name: replace(lens, distortion=np.array([1e-9, *[0.0] * 7]))
        for name, lens in ball.model.lenses.items()
    }
    ball.model = replace(ball.model, lenses=bent)
    scores = ball.score()
    assert scores.surface is not None and scores.surface.paper_chamfer == 0
    assert scores.mean("alpha_iou") is None
    assert "lens distortion" in scores.notes["alpha_iou"]


def test_truth_of_another_shape_than_its_photo_is_refused(ball: Oracle) -> None:
    for path in ball.root.glob("*/r_*.png"):
        if "normal" not in path.name:
            wide = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            cv2.imwrite(str(path), wide[:32])
    for path in ball.root.glob("*/r_*_*"):
        path.unlink()
    with pytest.raises(InputError, match="64 x 32 pixels, the view 64 x 64"):
        ball.score(picture=lambda image: np.concatenate([image, image]))


def test_the_picture_that_is_timed_is_drawn_once_more_to_warm_up(ball: Oracle) -> None:
    drawn = list[str]()

    def draw(camera: Camera) -> np.ndarray:
        drawn.append(camera.name)
        return np.zeros((2, 3, 3), np.float32)

    timed = Timed(draw)
    assert timed.per_second == 0
    for camera in ball.model.cameras[:2]:
        timed(camera)
    first, second = (camera.name for camera in ball.model.cameras[:2])
    assert drawn == [first, first, second]
    assert timed.per_second > 0 and timed.size == (3, 2)


@pytest.mark.slow
@scenes.needs_scenes
@pytest.mark.parametrize("name", ["spheres", "kettle", "mug"])
def test_a_path_traced_scene_scores_as_it_deserves(name: str, tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    oracle = Oracle(scenes.SCENES / name, Stages(tmp_path / "stages"))
    check_perfect(oracle.score())
    check_known_errors(oracle)
    check_a_shift_by_one_percent(oracle)
