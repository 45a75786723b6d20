"""Placement on captures that were damaged on purpose, and side by side with stock COLMAP.

    pytest -m benchmark -s tests/benchmarks/bench_placement.py

The first benchmark runs ingest, sfm and gate on every capture of REFDGS_CAPTURES (folders with
`images` and `cameras_gt.json`, with colons between; default: those with ground truth beside the
project) in every damage, and holds the answer against the truth. A cell is wrong if it is accepted
with places that are wrong, or refused with places that are right. What was found for a cell is
kept in the folder REFDGS_PLACEMENT (default: a new one); a call goes on where an earlier one
stopped, and judges what is there anew. The second runs pycolmap with its own defaults on the same
files. About one minute of one core for a cell.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from captures import SHARED, Stages, needs_shared
from PIL import Image

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.geometry import robust_similarity
from refdgs_pipe.sfm.gate import Judgement, examine
from refdgs_pipe.sfm.on_ground import judged_on_ground

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(36000)]

SIDE, PHOTOS, FEATURES = 480, 20, 2000  # small: what is tested is the judgement
RIGHT = 2.0  # % of the camera distance: a centre that is nearer to the truth is right
WRONG = 5.0  # and one that is farther is wrong
LEAST = 0.7

Photo = tuple[str, Image.Image]
Damage = Callable[[list[Photo], "Source"], list[Photo]]


@dataclass(frozen=True)
class Source:
    """A capture with its truth: file stem -> true centre, azimuth in degrees, mask's folder."""

    name: str
    folder: Path
    centers: dict[str, np.ndarray]

    @property
    def azimuths(self) -> dict[str, float]:
        return {
            name: float(np.degrees(np.arctan2(c[1], c[0]))) % 360
            for name, c in self.centers.items()
        }


def sources() -> list[Source]:
    default = [SHARED / n for n in ("kettle_capture", "kettle_flash", "kettle_turntable")]
    given = os.environ.get("REFDGS_CAPTURES")
    folders = [Path(text) for text in given.split(":")] if given else default
    found = []
    for folder in folders:
        frames = json.loads((folder / "cameras_gt.json").read_text())["frames"]
        centers = {
            Path(f["file"]).stem: np.array(f["transform_matrix"], float)[:3, 3] for f in frames
        }
        found.append(Source(folder.name, folder, centers))
    return found


def _every(photos: list[Photo], count: int) -> list[Photo]:
    rows = np.linspace(0, len(photos) - 1, min(count, len(photos))).round().astype(int)
    return [photos[i] for i in rows]


def _plain(photos: list[Photo], source: Source) -> list[Photo]:
    return photos


def _few(photos: list[Photo], source: Source) -> list[Photo]:
    return photos[::3]


def _arc(photos: list[Photo], source: Source) -> list[Photo]:
    return [(n, p) for n, p in photos if source.azimuths[n] > 120]


def _two_arcs(photos: list[Photo], source: Source) -> list[Photo]:
    return [(n, p) for n, p in photos if source.azimuths[n] % 180 > 90]


def _copies(photos: list[Photo], source: Source) -> list[Photo]:
    return photos[::3] + [(f"{n}_copy", p) for n, p in photos[::3]]


def _blurred(photos: list[Photo], source: Source) -> list[Photo]:
    return [(n, _filtered(p, 4.0) if i % 2 else p) for i, (n, p) in enumerate(photos)]


def _all_blurred(photos: list[Photo], source: Source) -> list[Photo]:
    return [(n, _filtered(p, 3.0)) for n, p in photos]


def _mirrored(photos: list[Photo], source: Source) -> list[Photo]:
    flip = Image.Transpose.FLIP_LEFT_RIGHT
    return [(n, p.transpose(flip) if i % 3 == 1 else p) for i, (n, p) in enumerate(photos)]


def _mixed(photos: list[Photo], source: Source) -> list[Photo]:
    """Every second photo is of another capture: there is no one object."""
    other = SHARED / "photos" / "fox"
    strangers = sorted(other.glob("*.jpg"))
    out = list(photos)
    for i in range(1, len(out), 2):
        with Image.open(strangers[i % len(strangers)]) as image:
            out[i] = (f"{out[i][0]}x", image.convert("RGB").resize(out[i][1].size))
    return out


def _dark(photos: list[Photo], source: Source) -> list[Photo]:
    rng = np.random.default_rng(0)
    out = []
    for name, photo in photos:
        pixels = np.asarray(photo, float) / 12 + rng.normal(0, 3, (photo.height, photo.width, 3))
        out.append((name, Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8))))
    return out


def _pasted(photos: list[Photo], source: Source) -> list[Photo]:
    """Every object before the background of one photo, as before a backdrop that moves along."""
    return _composed(photos, source, np.asarray(photos[0][1]))


def _bare(photos: list[Photo], source: Source) -> list[Photo]:
    """Every object before plain grey: nothing but the object is left to match."""
    return _composed(photos, source, np.full_like(np.asarray(photos[0][1]), 150))


def _composed(photos: list[Photo], source: Source, behind: np.ndarray) -> list[Photo]:
    out = []
    for name, photo in photos:
        with Image.open(source.folder / "masks" / f"{name}.png") as image:
            mask = np.asarray(image.convert("L").resize(photo.size)) > 127
        pixels = np.where(mask[..., None], np.asarray(photo), behind)
        out.append((name, Image.fromarray(pixels)))
    return out


def _filtered(photo: Image.Image, sigma: float) -> Image.Image:
    return Image.fromarray(cv2.GaussianBlur(np.asarray(photo), (0, 0), sigma))


DAMAGES: dict[str, Damage] = {
    "plain": _plain,
    "few": _few,
    "arc": _arc,
    "two arcs": _two_arcs,
    "copies": _copies,
    "half blurred": _blurred,
    "all blurred": _all_blurred,
    "mirrored": _mirrored,
    "mixed": _mixed,
    "dark": _dark,
    "pasted": _pasted,
    "bare": _bare,
}


def _write(source: Source, damage: Damage, folder: Path) -> None:
    """The damaged capture, with the EXIF of the photos."""
    files = sorted((source.folder / "images").glob("*.jpg"))
    photos, exif = [], b""
    for file in files:
        with Image.open(file) as image:
            exif = image.info.get("exif", b"")
            small = image.convert("RGB")
            small.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
            photos.append((file.stem, small))
    folder.mkdir(parents=True)
    for name, photo in damage(_every(photos, PHOTOS), source):
        photo.save(folder / f"{name}.jpg", quality=92, exif=exif)


def errors(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> dict[str, float]:
    """How far centres lie from the truth after alignment, in % of the camera distance.

    The similarity is that of the three photos that most others agree with, then of all these.
    """
    names = [name for name in found if name in truth]
    if len(names) < 4:
        return {}
    a, b = (np.stack([table[name] for name in names]) for table in (found, truth))
    distance = float(np.median(np.linalg.norm(b, axis=1)))

    def off(world: np.ndarray) -> np.ndarray:
        return 100 * np.linalg.norm(a @ world[:3, :3].T + world[:3, 3] - b, axis=1) / distance

    rng = np.random.default_rng(0)
    best = robust_similarity(a, b)
    for _ in range(300):
        three = rng.choice(len(names), 3, replace=False)
        if np.linalg.matrix_rank(b[three] - b[three].mean(0), tol=0.1 * distance) < 2:
            continue
        world = robust_similarity(a[three], b[three])
        if (off(world) <= RIGHT).sum() > (off(best) <= RIGHT).sum():
            best = world
    near = off(best) <= RIGHT
    if near.sum() >= 4:
        best = robust_similarity(a[near], b[near])
    return {name: float(value) for name, value in zip(names, off(best), strict=True)}


def _judge(
    source: Source, placement: Placement, judgement: Judgement, total: int
) -> dict[str, Any]:
    """The verdict held against the truth."""
    placed = {} if placement.poses is None else placement.poses.cam_from_world
    centers = {
        file.removesuffix(".png"): -pose[:3, :3].T @ pose[:3, 3] for file, pose in placed.items()
    }
    of_all = errors(centers, source.centers)
    model = judgement.model
    kept = {} if model is None else {camera.name: camera.center for camera in model.cameras}
    of_kept = errors(kept, source.centers)
    right = sum(value <= RIGHT for value in of_all.values())
    strangers = sum(name not in source.centers for name in kept)
    wrong = sum(value > WRONG for value in of_kept.values()) + strangers
    middle = float(np.median(list(of_kept.values()))) if of_kept else float("nan")
    is_right = bool(of_kept) and middle <= RIGHT and wrong <= 0.05 * len(kept)
    accepted = judgement.is_trusted
    return {
        "photos": total,
        "placed": len(placed),
        "trusted": len(kept),
        "accepted": accepted,
        "median_error": middle,
        "wrong_trusted": wrong,
        "right_placed": right,
        "false_accept": accepted and not is_right,
        "false_refusal": not accepted and right >= LEAST * total,
        "rungs": [a.name for a in placement.attempts],
        "errors": {name: round(value, 3) for name, value in of_all.items()},
        "checks": {check.name: [check.found, check.is_met] for check in judgement.checks},
    }


def _cell(source: Source, name: str, folder: Path) -> dict[str, Any]:
    """Placed once, judged at each call."""
    if not (folder / "found").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _write(source, DAMAGES[name], folder / "photos")
        stages = Stages(folder / "work")
        try:
            views = stages.ingest(folder / "photos")
            stages.run("sfm", {"views": views}, {"max_features": FEATURES})
            (folder / "found").write_text("")
        except RefdgsError as error:
            (folder / "found").write_text(str(error))
        shutil.rmtree(folder / "work" / ".scratch-sfm", ignore_errors=True)
    if not (folder / "work" / "sfm" / "placement.json").exists():
        nothing = {"photos": len(list((folder / "photos").iterdir())), "placed": 0, "trusted": 0}
        refused = {"accepted": False, "false_accept": False, "false_refusal": False}
        return nothing | refused | {"said": (folder / "found").read_text()}
    views = Views.load(folder / "work" / "ingest")
    placement = Placement.load(folder / "work" / "sfm")
    judgement, _ = judged_on_ground(
        views, placement, examine(views, placement, least=LEAST), lambda *_: None, least=LEAST
    )
    return _judge(source, placement, judgement, len(views.items))


@needs_shared
def test_damaged_captures_are_refused_or_right() -> None:
    out = Path(os.environ.get("REFDGS_PLACEMENT") or tempfile.mkdtemp())
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for source in sources():
        for name in DAMAGES:
            cell = out / f"{source.name}-{name.replace(' ', '_')}"
            record = {"capture": source.name, "damage": name, **_cell(source, name, cell)}
            (cell / "record.json").write_text(json.dumps(record, indent=1))
            rows.append(record)
            print(_line(rows[-1]), flush=True)
    accepts = sum(row["false_accept"] for row in rows)
    refusals = sum(row["false_refusal"] for row in rows)
    print(f"{len(rows)} captures, false accepts {accepts}, false refusals {refusals}: {out}")


def _line(row: dict[str, Any]) -> str:
    word = "accepted" if row["accepted"] else "refused"
    wrong = "FALSE ACCEPT" if row["false_accept"] else "FALSE REFUSAL"
    flag = wrong if row["false_accept"] or row["false_refusal"] else ""
    return (
        f"{row['capture']:22} {row['damage']:13} {word:9} {row['trusted']:3} trusted, "
        f"{row['placed']:3} placed of {row['photos']:3}, "
        f"error {row.get('median_error', 0):6.2f} % {flag}"
    )


def stock(images: str, folder: str) -> int:
    """How many photos pycolmap places with its own defaults. Runs in a process of its own."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    database = Path(folder) / "database.db"
    pycolmap.extract_features(
        database, Path(images), camera_mode=pycolmap.CameraMode.AUTO, device=pycolmap.Device.cpu
    )
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    found = pycolmap.incremental_mapping(database, Path(images), Path(folder))
    return max((model.num_reg_images() for model in found.values()), default=0)


@needs_shared
@pytest.mark.parametrize(
    "place",
    [
        "photos/fox",
        "photos/skull",
        *(f"{name}/images" for name in ("kettle_capture", "kettle_flash", "kettle_turntable")),
    ],
)
def test_stock_colmap_never_places_more(place: str, tmp_path: Path) -> None:
    (tmp_path / "stock").mkdir()
    images, folder = str(SHARED / place), str(tmp_path / "stock")
    theirs = call_in_child("bench_placement:stock", {"images": images, "folder": folder})
    stages = Stages(tmp_path)
    views = stages.ingest(SHARED / place)
    judgement = examine(views, stages.run("sfm", {"views": views}, {}), least=LEAST)
    ours = len(views.items) - len(judgement.lost)
    print(f"{place}: ours {ours} trusted, stock {theirs} placed, of {len(views.items)}")
    assert ours >= theirs
