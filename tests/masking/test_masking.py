"""Masks that are found in the photos: a textured table, an object on it, and photos all round."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import looking
from PIL import Image

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.ground.shots import Shot
from refdgs_pipe.masking import foot, rounds
from refdgs_pipe.masking.colours import with_colour
from refdgs_pipe.masking.contact import heard_of, low, standing, without_bites
from refdgs_pipe.masking.cut import cut
from refdgs_pipe.masking.files import distorted, write_masks
from refdgs_pipe.masking.finding import agreement, object_masks
from refdgs_pipe.masking.held import held
from refdgs_pipe.masking.solid import (
    Cells,
    agreed,
    covering,
    grid,
    silhouette,
)

BALL = Ball(np.array([0.0, 0.0, 0.45]), 1.0)
UP = np.array([0.0, 0.0, 1.0])
CENTER, RADIUS = np.array([0.0, 0.0, 0.42]), 0.42
SIZE = (200, 150)


def camera(i: int, count: int) -> Camera:
    """One of a ring at two heights, 3.2 away."""
    around, up = 2 * np.pi * i / count, np.radians(28 if i % 2 else 50)
    eye = 3.2 * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    pose = looking(eye, (0.0, 0.0, 0.45))
    K = np.array([[200.0, 0, SIZE[0] / 2], [0, 200.0, SIZE[1] / 2], [0, 0, 1]])
    return Camera(f"IMG_{i:02d}", *SIZE, K, pose)


def print_at(places: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB of a printed table at (N, 2): blots of random size and colour."""
    random = np.random.default_rng(3)
    blots = cv2.resize(random.random((60, 60, 3)), (600, 600), interpolation=cv2.INTER_CUBIC)
    index = np.clip((places / 8 + 0.5) * 600, 0, 599).astype(int)
    return np.asarray(blots[index[:, 1], index[:, 0]].clip(0.05, 0.95))


def photographed(shot: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) sRGB and (H, W) truth: a mirror ball on a printed table, below a striped sky."""
    rays = shot.pixel_rays().reshape(-1, 3) @ shot.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = np.broadcast_to(shot.center, rays.shape)
    offset = shot.center - CENTER
    b = rays @ offset
    root = b * b - (offset @ offset - RADIUS**2)
    hit = root > 0
    points = origin + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * rays
    normals = (points - CENTER) / RADIUS
    mirrored = rays - 2 * (rays * normals).sum(1, keepdims=True) * normals
    start = np.where(hit[:, None], points, origin)
    along = np.where(hit[:, None], mirrored, rays)
    down = along[:, 2] < -1e-3
    t = np.where(down, -start[:, 2] / np.where(down, along[:, 2], -1), 0)
    table = print_at((start + t[:, None] * along)[:, :2].clip(-3.9, 3.9))
    stripes = 0.5 + 0.4 * np.sin(9 * np.arctan2(along[:, 1], along[:, 0]))
    sky = np.stack([stripes, 0.6 * np.ones_like(stripes), 1 - 0.5 * stripes], -1)
    rgb = np.where(down[:, None], table, sky) * np.where(hit[:, None], [0.8, 0.75, 0.7], 1)
    return rgb.reshape(*SIZE[::-1], 3), hit.reshape(SIZE[::-1])


@pytest.fixture(scope="module")
def capture(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Views, SparseModel, list[np.ndarray]]:
    """Fourteen photos of a mirror ball on a printed table, and their true masks."""
    folder = tmp_path_factory.mktemp("ball")
    cameras = [camera(i, 14) for i in range(14)]
    items, truth = [], []
    for one in cameras:
        rgb, mask = photographed(one)
        Image.fromarray(np.rint(255 * rgb).astype(np.uint8)).save(folder / f"{one.name}.png")
        items.append(
            View(
                one.name, f"{one.name}.png", *SIZE, None, "train", Exif(), 1.0, 0.5, None, one.name
            )
        )
        truth.append(mask)
    lens = Lens(cameras[0].K, np.zeros(8))
    model = SparseModel(
        tuple(cameras),
        {one.name: lens for one in cameras},
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        {},
        BALL,
        UP,
        np.eye(4),
        None,
        (),
    )
    return Views(folder, tuple(items), "srgb", "photo"), model, truth


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solid, and the ground where its foot is looked for, of few cells: the photos are small."""
    levels = tuple(replace(level, solid=64) for level in rounds.LEVELS)
    monkeypatch.setattr(rounds, "LEVELS", levels)
    monkeypatch.setattr(rounds, "LAST", replace(rounds.LAST, solid=72))
    monkeypatch.setattr(foot, "LEVELS", [replace(foot.LEVELS[-1], cells=192)])


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


@pytest.mark.usefixtures("coarse")
def test_a_mirror_ball_on_a_printed_table_is_found(
    capture: tuple[Views, SparseModel, list[np.ndarray]],
) -> None:
    views, model, truth = capture
    found = object_masks(views, model, (UP, 0.0), lambda done, total: None, threads=2)
    assert found is not None
    shares = [overlap(m > 0.5, t) for m, t in zip(found.masks, truth, strict=True)]
    assert np.mean(shares) > 0.93
    assert min(shares) > 0.85
    assert agreement(found)[0] > 0.9


@pytest.mark.slow
def test_masks_do_not_depend_on_the_number_of_threads(
    capture: tuple[Views, SparseModel, list[np.ndarray]],
) -> None:
    views, model, _ = capture
    one, three = (
        object_masks(views, model, (UP, 0.0), lambda done, total: None, threads=count)
        for count in (1, 3)
    )
    assert one is not None and three is not None
    for mask, same in zip(one.masks, three.masks, strict=True):
        np.testing.assert_array_equal(mask, same)


@pytest.mark.usefixtures("coarse")
def test_an_empty_table_has_no_masks(
    capture: tuple[Views, SparseModel, list[np.ndarray]], tmp_path: Path
) -> None:
    views, model, _ = capture
    for one in model.cameras:
        rays = one.pixel_rays().reshape(-1, 3) @ one.cam_from_world[:3, :3]
        t = one.center[2] / np.maximum(-rays[:, 2], 1e-3)
        rgb = print_at((one.center + t[:, None] * rays)[:, :2].clip(-3.9, 3.9))
        pixels = np.rint(255 * rgb.reshape(*SIZE[::-1], 3)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{one.name}.png")
    found = object_masks(
        replace(views, folder=tmp_path), model, (UP, 0.0), lambda a, b: None, threads=2
    )
    assert found is None or agreement(found)[0] < 0.9


def test_the_cut_follows_the_edge_between_uncertain_pixels() -> None:
    rgb = np.zeros((40, 40, 3), np.float32)
    rgb[:, 20:] = 1
    evidence = np.zeros((40, 40), np.float32)
    evidence[:, :12], evidence[:, 28:] = -2, 2
    inside = cut(evidence, rgb, weight=0.5) > 0.5
    assert inside[5:35, :20].all()
    assert not inside[5:35, 20:].any()


def ring_of_shots(count: int = 8) -> tuple[list[Shot], list[np.ndarray]]:
    """Photos of a ring without their colours, and where each shows the ball."""
    shots = []
    for i in range(count):
        one = camera(i, count)
        nothing = np.zeros((*SIZE[::-1], 3), np.float32)
        shots.append(Shot(one, nothing, np.ones(SIZE[::-1], bool), (0, SIZE[0], 0, SIZE[1]), SIZE))
    return shots, [photographed(shot.camera)[1] for shot in shots]


def test_the_planes_colour_is_no_evidence_for_it_where_the_object_stands() -> None:
    value = np.zeros((1, 4), np.float32)
    colour = np.array([[2.0, -2.0, 2.0, -2.0]], np.float32)
    covers = np.array([[True, True, False, False]])
    near = np.ones((1, 4), bool)
    found = with_colour(value, colour, near, covers)[0]
    assert found[0] == 0 and found[1] < 0 < found[2] and found[3] < 0
    far = with_colour(value, colour, ~near, covers)[0]
    assert far[2] > 0 and not far[[0, 1, 3]].any()
    sure = with_colour(value + 3, colour, near, covers)[0]
    assert (sure == 3).all()


def test_a_cell_that_photos_deny_is_not_solid() -> None:
    cells = grid(BALL, UP, 0.0, 32)
    shots, truth = ring_of_shots()
    known = [np.ones_like(t) for t in truth]
    solid = agreed(cells, shots, truth, known, UP, deny=0.0)
    distance = np.linalg.norm(cells.points - CENTER, axis=1)
    assert solid[distance < RADIUS - 2 * cells.size].all()
    assert not solid[distance > 1.6 * RADIUS].any()
    shown = silhouette(cells, solid, shots[0])
    assert overlap(shown, truth[0]) > 0.85


@pytest.mark.parametrize("lost", [0.2, 0.4])
def test_a_little_that_photos_are_sure_of_comes_back_where_others_deny_it(lost: float) -> None:
    cells = grid(BALL, UP, 0.0, 32)
    shots, truth = ring_of_shots()
    known = [np.ones_like(t) for t in truth]
    free = [t.copy() for t in truth]
    for i in (0, 2, 4):  # photos from above lose the ball's far side
        rows = np.flatnonzero(truth[i].any(1))
        free[i][: int(rows[0] + lost * len(rows))] = False
    solid = agreed(cells, shots, free, known, UP, deny=0.08)
    unsure = [np.zeros_like(t) for t in truth]
    assert (covering(cells, solid, shots, free, known, unsure) == solid).all()
    sure = [t if i % 2 else ~t & t for i, t in enumerate(truth)]
    back = covering(cells, solid, shots, free, known, sure)
    added = back & ~solid
    if lost > 0.3:  # that much is not the object's
        assert not added.any()
        return
    assert (back >= solid).all() and added.sum() > 0.01 * solid.sum()
    away = np.linalg.norm(cells.points - CENTER, axis=1)
    assert away[added].max() < 1.3 * RADIUS
    assert np.mean(cells.points[added, 2] > CENTER[2]) > 0.95  # where it was lost


def test_what_two_photos_ask_for_comes_back_although_one_photo_asks_for_too_much() -> None:
    cells = grid(BALL, UP, 0.0, 32)
    shots, truth = ring_of_shots()
    known = [np.ones_like(t) for t in truth]
    wide = [cv2.dilate(t.astype(np.uint8), np.ones((9, 9))) > 0 for t in truth]
    free = [w if i % 2 else t.copy() for i, (w, t) in enumerate(zip(wide, truth, strict=True))]
    for i in (0, 2, 4):  # photos from above lose the ball's far side
        rows = np.flatnonzero(truth[i].any(1))
        free[i][: int(rows[0] + 0.2 * len(rows))] = False
    solid = agreed(cells, shots, free, known, UP, deny=0.08)
    sure = [t if i % 2 else np.zeros_like(t) for i, t in enumerate(truth)]
    sure[1] = wide[1]
    back = covering(cells, solid, shots, free, known, sure)
    added = back & ~solid
    away = np.linalg.norm(cells.points - CENTER, axis=1)
    assert added.sum() > 0.01 * solid.sum()
    assert np.mean(away[added] < 1.1 * RADIUS) > 0.9
    assert (covering(cells, solid, shots, free, known, sure, turns=True) == solid).all()


@pytest.mark.parametrize("denying", [0, 3])
def test_what_photos_above_the_plane_agree_on_is_held_for_solid(denying: int) -> None:
    """Photos from above tell by the plane; low ones cannot, and are told what they may show."""
    cells = grid(BALL, UP, 0.0, 48)
    shots, truth = ring_of_shots(24)
    values = [np.where(t, -2.0, 2.0).astype(np.float32) for t in truth]
    for i in range(0, 2 * denying, 2):
        values[i][:] = 2.0  # takes the object for the plane
    asked = [np.full(t.shape, i % 2 == 0) for i, t in enumerate(truth)]
    seen = held(cells, shots, values, asked)
    if denying:  # more than a tenth of those that can tell
        assert not any(one.any() for one in seen)
        return
    for one, whole in zip(seen[1::2], truth[1::2], strict=True):
        assert one[whole].mean() > 0.97
        assert one[~whole].mean() < 0.04


def test_nothing_is_held_where_few_photos_can_tell() -> None:
    cells = grid(BALL, UP, 0.0, 48)
    shots, truth = ring_of_shots(24)
    values = [np.where(t, -2.0, 2.0).astype(np.float32) for t in truth]
    asked = [np.full(t.shape, i % 5 == 0) for i, t in enumerate(truth)]
    assert not any(one.any() for one in held(cells, shots, values, asked))


def many_photos(
    cells: Cells, deny: float
) -> tuple[list[Shot], list[np.ndarray], list[np.ndarray], np.ndarray]:
    """24 photos of the ball: shots, where they may show it, where they can tell; and its cells."""
    shots, truth = ring_of_shots(24)
    free = [cv2.dilate(t.astype(np.uint8), np.ones((3, 3))) > 0 for t in truth]
    known = [np.ones_like(t) for t in truth]
    return shots, free, known, agreed(cells, shots, free, known, UP, deny=deny)


@pytest.mark.parametrize("denying", [1, 4])
def test_a_foot_that_one_photo_of_many_denies_comes_back(denying: int) -> None:
    cells = grid(BALL, UP, 0.0, 64)
    shots, free, known, whole = many_photos(cells, 0.0)
    height = cells.points[:, 2]
    foot = whole & (height < 0.03)
    assert (foot <= low(cells, UP, 0.0)).all()
    shoulder = whole & (height > 0.5)  # what is high does not come back
    for i in range(denying):
        free[i] &= ~silhouette(cells, foot, shots[i])
    cut_off = whole & ~foot & ~shoulder
    back = standing(cells, cut_off, shots, free, known, (UP, 0.0)) & ~cut_off
    if denying > 1:
        assert not back[foot].any()
        return
    assert back[foot].mean() > 0.9
    assert not (back & ~whole)[height > 0.06].any() and not back[shoulder].any()


@pytest.mark.parametrize("proven", [False, True])
def test_a_bite_of_the_foot_comes_back_unless_its_ground_is_proven(proven: bool) -> None:
    """Photos of one side take the foot for the ground; no other photo proves that ground."""
    cells = grid(BALL, UP, 0.0, 96)
    shots, free, known, whole = many_photos(cells, 0.06)
    side = np.arctan2(cells.points[:, 1], cells.points[:, 0])
    height = cells.points[:, 2]
    outer = np.hypot(cells.points[:, 0], cells.points[:, 1]) > 0.2
    bite = whole & outer & (height > 0.05) & (height < 0.15) & (np.abs(side) < 0.2)
    assert bite.sum() > 10
    denying = [i for i, shot in enumerate(shots) if shot.camera.center[0] > 2]
    for i in denying:
        free[i] &= ~silhouette(cells, bite, shots[i])
    heard = heard_of(free, known, [np.full_like(k, proven) for k in known])
    back = without_bites(cells, whole & ~bite, shots, free, known, heard, (UP, 0.0), deny=0.06)
    added = back & ~(whole & ~bite)
    assert (added & ~whole).sum() < 0.1 * bite.sum()
    assert added[bite].mean() == 0 if proven else added[bite].mean() > 0.5


def test_ground_below_a_body_that_hangs_all_round_is_no_bite() -> None:
    cells = grid(BALL, UP, 0.0, 64)
    shots, free, known, whole = many_photos(cells, 0.0)
    hanging = whole & (cells.points[:, 2] > 0.1)
    heard = heard_of(free, known, [np.zeros_like(k) for k in known])
    back = without_bites(cells, hanging, shots, free, known, heard, (UP, 0.0), deny=0.06)
    assert (back == hanging).all()


def test_masks_are_written_as_the_lens_drew_the_photo(
    capture: tuple[Views, SparseModel, list[np.ndarray]], tmp_path: Path
) -> None:
    views, model, truth = capture
    one = model.cameras[0]
    lens = Lens(one.K, np.array([0.2, 0, 0, 0, 0, 0, 0, 0.0]))
    bent = distorted(truth[0].astype(np.float32), one, lens, *SIZE)
    edge = np.argwhere(bent > 0.5)[0][::-1] + 0.5
    straight = cv2.undistortPoints(edge.reshape(1, 1, 2), lens.K, lens.distortion, P=one.K)[0, 0]
    column, row = np.floor(straight).astype(int)
    near = truth[0][row - 2 : row + 3, column - 2 : column + 3]
    assert near.any() and not near.all()
    write_masks(tmp_path, views, model, [t.astype(np.float32) for t in truth])
    masks = Masks(tmp_path, tuple(model.names), "found")
    used = masks.applied(views, model.names)
    assert used.background == "masked"
    stored = cv2.imread(str(used.mask_path(used.items[0])), cv2.IMREAD_UNCHANGED)
    assert overlap(stored > 127, truth[0]) == 1.0


def test_masks_are_kept_and_damage_is_said(tmp_path: Path) -> None:
    Masks(tmp_path, (), "none", "no plane").save(tmp_path)
    assert Masks.load(tmp_path) == Masks(tmp_path, (), "none", "no plane")
    (tmp_path / "masks.json").write_text("{}")
    with pytest.raises(CorruptError, match=r"masks\.json"):
        Masks.load(tmp_path)


def test_a_folder_of_masks_is_adopted_and_a_missing_one_is_named(
    capture: tuple[Views, SparseModel, list[np.ndarray]], tmp_path: Path
) -> None:
    views, model, truth = capture
    with pytest.raises(InputError, match="folder"):
        Masks.adopt(tmp_path / "none")
    with pytest.raises(InputError, match="no PNG"):
        Masks.adopt(tmp_path)
    for name, mask in zip(model.names[1:], truth[1:], strict=True):
        Image.fromarray(mask).save(tmp_path / f"{name}.png")
    first = tmp_path / f"{model.names[1]}.png"
    good = first.read_bytes()
    Image.fromarray(np.zeros_like(truth[1])).save(first)
    with pytest.raises(InputError, match="shows no object"):
        Masks.adopt(tmp_path)
    first.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match=rf"{first.name}.*white where the object is"):
        Masks.adopt(tmp_path)
    first.write_bytes(good)
    masks = Masks.adopt(tmp_path)
    with pytest.raises(InputError, match=model.names[0]):
        masks.applied(views, model.names)
    assert masks.applied(views, model.names[1:]).background == "masked"
