"""Structure from motion with pycolmap, to be run in a process of its own: it can abort.

The photos lie as PNGs in one folder, upright; what EXIF says of the focal length comes as `Shots`.
Equal inputs give equal poses: ids follow the names, mapping runs on one thread and is seeded.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, whose zlib would break cv2's PNG writer
import numpy as np
import pycolmap

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.sfm import database as base
from refdgs_pipe.sfm import mapping
from refdgs_pipe.sfm.evidence import Known, hold_out, poses_of
from refdgs_pipe.sfm.poses import Effort, Found, OnProgress, Shots
from refdgs_pipe.sfm.still import Features, Still, find_still
from refdgs_pipe.sfm.trust import deviation, standing, trusted

GOOD = 0.9  # share trusted under which a lenient mapper and the global one are tried too
CREDIBLE = 0.8  # of the trusted photos: a solution with fewer is no evidence against the other
LEAST_KEPT = 5  # trusted photos that others can be placed from
LEAST_MATCHES = 15  # of a pair that is verified again, as COLMAP's own limit


def reconstruct(
    images: Path,
    shots: tuple[Shots, ...],
    masks: Path | None,
    effort: Effort,
    scratch: Path,
    progress: OnProgress,
) -> Found:
    """Place as many of the photos as possible; without a start no poses, but what was matched.

    Args:
        masks: folder of NAME.png.png, black where features are ignored.
        effort: with a number as its `first_octave`.
        scratch: a folder for the database and the models; what is in it is replaced.

    Returns:
        The poses, and notes: what was found out about the capture, in sentences.
    """
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(base.SEED)
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    scratch = scratch.resolve()
    database = scratch / "database.db"
    files = sorted(file for group in shots for file in group.files)
    base.register(database, shots)
    base.extract(database, images, masks, effort, progress, files)
    base.match(database, files, effort, progress)
    still = _without_still(database, progress)
    solver = _Solver(database, images, scratch, progress, still)
    best = solver.anew("incremental")
    lost = [file for file in files if file not in best.poses.cam_from_world]
    if lost and best.poses.cam_from_world and len(files) > base.EXHAUSTIVE_UP_TO:
        pairs = [(a, b) for a in sorted(lost) for b in files if a != b]
        base.match_pairs(database, pairs, effort, progress)
        best = max(best, solver.anew("again"), key=_standing)
    best = solver.further(best, "further")
    if best.placed < len(files):
        whole = solver.anew("whole", holding_out=False)
        best = max(best, solver.further(whole, "whole further"), key=_standing)
    if _standing(best)[0] < GOOD * len(files):
        best = max(best, solver.anew("few", lenient=True), key=_standing)
    poses = best.poses
    if _standing(best)[0] < GOOD * len(files):
        progress("solving all poses at once", 0, None)
        model = mapping.all_at_once(database, images, scratch / "global")
        if model is not None:
            known = Known(still.share, frozenset())
            found = poses_of(mapping.refined(model), "global", database, known)
            credible = standing(found)[0] >= CREDIBLE * standing(poses)[0]
            rival = deviation(poses, found) if credible else None
            poses = replace(max(poses, found, key=standing), rival=rival)
    return poses, _notes(still)


@dataclass(frozen=True)
class _Found:
    """One reconstruction.

    Args:
        model: with the lens that it was mapped with; None where there is none.
        part: the database that it was made of; known: the pairs that are not in it.
    """

    poses: Poses
    model: Any
    part: Path
    known: Known

    @property
    def placed(self) -> int:
        """How many photos have a place."""
        return len(self.poses.cam_from_world)


def _standing(found: _Found) -> tuple[int, int, int]:
    return standing(found.poses)


@dataclass(frozen=True)
class _Solver:
    """The incremental mapper over one database, in several ways."""

    database: Path
    images: Path
    scratch: Path
    progress: OnProgress
    still: Still

    def anew(self, name: str, *, holding_out: bool = True, lenient: bool = False) -> _Found:
        """The reconstruction with the most trusted photos, from nothing.

        Args:
            name: of a folder.
            holding_out: whether some pairs are kept from the mapper, as evidence.
        """
        folder = self.scratch / name
        folder.mkdir()
        part = folder / "database.db"
        shutil.copyfile(self.database, part)
        known = Known(self.still.share, hold_out(part) if holding_out else frozenset())
        told = self._placing(0)
        models = mapping.incremental(part, self.images, folder, told, lenient=lenient)
        large = [m for m in models if 2 * mapping.size(m)[0] >= mapping.size(models[0])[0]]
        found = [self._found(model, part, known) for model in large]
        return max(found, key=_standing) if found else self._found(None, part, known)

    def further(self, found: _Found, name: str) -> _Found:
        """The same, or better: photos without a trusted place are placed anew from the others.

        Fewer matches than usual place a photo. A photo with a wrong place bends points to itself,
        so it is taken out with its sights first.

        Args:
            name: of a folder.
        """
        kept = trusted(found.poses)
        if found.model is None or len(kept) == len(self.still.share):
            return found
        folder = self.scratch / name
        folder.mkdir()
        start = mapping.only(found.model, kept) if len(kept) >= LEAST_KEPT else found.model
        told = self._placing(mapping.size(start)[0])
        models = mapping.incremental(
            found.part, self.images, folder, told, lenient=True, start=start
        )
        again = [self._found(model, found.part, found.known) for model in models[:1]]
        return max([found, *again], key=_standing)

    def _found(self, model: Any, part: Path, known: Known) -> _Found:
        """With the poses of the refined model. The mapper goes on from the unrefined one only."""
        refined = None if model is None else mapping.refined(model)
        return _Found(poses_of(refined, "incremental", self.database, known), model, part, known)

    def _placing(self, placed: int) -> Callable[[int], None]:
        """Tells how many photos have a place so far."""
        count, total = [placed], len(self.still.share)

        def told(step: int) -> None:
            count[0] += step
            self.progress("placing photos", min(count[0], total), total)

        return told


def _without_still(database: Path, progress: OnProgress) -> Still:
    """Find what stands still; on a turntable take its matches away and verify the rest again."""
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        sides = [max(cameras[i.camera_id].width, cameras[i.camera_id].height) for i in images]
        features = [_features(db.read_keypoints(image.image_id)) for image in images]
        matches = {}
        for a, one in enumerate(images):
            for b in range(a + 1, len(images)):
                pair = (one.image_id, images[b].image_id)
                if db.exists_matches(*pair):
                    found = np.asarray(db.read_matches(*pair), np.int64).reshape(-1, 2)
                    matches[a, b] = found
        still = find_still(features, matches, sides)
        if not still.is_turntable:
            return still
        db.clear_matches()
        db.clear_two_view_geometries()
        pairs = []
        for (a, b), found in matches.items():
            left = found[still.kept[a, b]]
            if len(left) >= LEAST_MATCHES:
                db.write_matches(images[a].image_id, images[b].image_id, left.astype(np.uint32))
                pairs.append((images[a].name, images[b].name))
    base.verify_again(database, pairs, progress)
    return still


def _features(keypoints: Any) -> Features:
    """COLMAP's keypoints x, y and an affine shape, as pixels and orientation."""
    if not len(keypoints):
        return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    data = np.asarray(keypoints, np.float32).reshape(len(keypoints), -1)
    if data.shape[1] < 6:
        turn = data[:, 3] if data.shape[1] == 4 else np.zeros(len(data), np.float32)
    else:
        turn = np.arctan2(data[:, 4], data[:, 2])
    return Features(data[:, :2], np.asarray(turn, np.float32))


def _notes(still: Still) -> tuple[str, ...]:
    if not still.is_turntable:
        return ()
    share = float(np.median(still.share))
    return (
        "the background stands still while the object turns, as on a turntable: the features that "
        f"keep their place in the picture are left out ({share:.0%} of a photo's matches)",
    )
