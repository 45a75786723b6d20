"""What stands still in the picture is told from what turns with the object."""

import numpy as np

from refdgs_pipe.sfm.still import Features, find_still

PHOTOS, OBJECT, ROOM, SIDE = 12, 60, 80, 640


def series(
    *, still: bool, seed: int = 0
) -> tuple[list[Features], dict[tuple[int, int], np.ndarray]]:
    """Photos of a turning object; the room behind it stands still, or moves as by hand."""
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0, 2 * np.pi, OBJECT), rng.uniform(30, 120, OBJECT)
    room = rng.uniform(0, SIDE, (ROOM, 2))
    features = []
    for photo in range(PHOTOS):
        turned = angle + photo * np.radians(30)
        thing = np.stack([320 + radius * np.cos(turned), 240 + 0.3 * radius * np.sin(turned)], 1)
        shift = np.zeros(2) if still else rng.uniform(-60, 60, 2)
        xy = np.concatenate([thing, room + shift]) + rng.normal(0, 0.3, (OBJECT + ROOM, 2))
        turn = np.concatenate([turned, np.zeros(ROOM)]) + rng.normal(0, 0.02, OBJECT + ROOM)
        features.append(Features(xy.astype(np.float32), turn.astype(np.float32)))
    same = np.stack([np.arange(OBJECT + ROOM)] * 2, 1)
    pairs = {(a, b): same for a in range(PHOTOS) for b in range(a + 1, PHOTOS)}
    return features, pairs


def test_a_turntables_background_goes_and_the_object_stays() -> None:
    features, pairs = series(still=True)
    found = find_still(features, pairs, [SIDE] * PHOTOS)
    assert found.is_turntable
    for kept in found.kept.values():
        assert not kept[OBJECT:].any()
        assert kept[:OBJECT].mean() > 0.95
    np.testing.assert_allclose(found.share, ROOM / (ROOM + OBJECT), atol=0.03)


def test_a_capture_by_hand_has_nothing_that_stands_still() -> None:
    features, pairs = series(still=False)
    found = find_still(features, pairs, [SIDE] * PHOTOS)
    assert not found.is_turntable
    assert max(found.share) < 0.05


def test_what_turns_in_its_place_is_no_background() -> None:
    """A mark on the table's axis keeps its pixel, but turns with the table."""
    features, pairs = series(still=True)
    on_axis = [
        Features(
            np.concatenate([one.xy[:OBJECT] * 0 + 320, one.xy[OBJECT:]]).astype(np.float32),
            one.turn,
        )
        for one in features
    ]
    found = find_still(on_axis, pairs, [SIDE] * PHOTOS)
    kept = found.kept[0, 4]
    assert kept[:OBJECT].mean() > 0.95 and not kept[OBJECT:].any()


def test_two_photos_that_share_a_background_make_no_turntable() -> None:
    features, pairs = series(still=False)
    features[1] = features[0]
    assert not find_still(features, pairs, [SIDE] * PHOTOS).is_turntable
