"""Small runs of known, very different quality over the captures with ground truth.

Each case is a folder of its own, damaged as its name says, and the settings of its run. The
pictures of TRUTH views are in no case: what a result truly looks like is told by them.
REFDGS_CAPTURES (folders as ../shared/generator writes them, with colons between) adds whole runs
of further captures.
"""

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
SCENES = ("spheres", "kettle", "mug")
TRAIN, TEST, TRUTH = 24, 4, 3  # views of a scene's case, and of its truth
CHEAP: dict[str, Any] = {
    "ingest.max_side": 112,
    "train.iterations": 200,
    "start.surfels": 2000,
    "train.max_surfels": 5000,
    "start.local_surfels": 800,
    "start.background_surfels": 3000,
    "start.look_steps": 40,
    "start.volume_steps": 0,
    "train.environment_height": 32,
    "extract.voxel": 0.016,
    "extract.pixels": 112,
    "clean.faces": 2000,
    "fit.outlines": 1,
    "appearance.samples": 3000,
    "appearance.light": 16,
    "unwrap.backend": "uvatlas",
    "bake.size": 128,
    "bake.refine": False,
    "evaluate.max_side": 112,
}


@dataclass(frozen=True)
class Case:
    """One run.

    Args:
        source: a scene, "capture" for the photos of the kettle with their background, or the
            name of another folder of `captures`.
        views: training photos that are kept; turned: degrees by which poses are wrong.
        masks: "", or how they are damaged: "wide", "narrow", "torn", "mixed", "given" (a capture).
        settings: besides CHEAP; whole: without CHEAP, as a user would run it.
        like: the case whose photos and field it shares; "": it has its own.
    """

    name: str
    source: str
    views: int = TRAIN
    turned: float = 0.0
    masks: str = ""
    arc: float = 360.0
    recipe: str = "preview"
    settings: dict[str, Any] = field(default_factory=dict)
    whole: bool = False
    like: str = ""

    @property
    def photos(self) -> bool:
        """Whether its pictures are photos with a background, and not renders on white."""
        return self.source not in SCENES


def captures() -> dict[str, Path]:
    """The folders with photos and truth: name -> folder."""
    given = [Path(text) for text in os.environ.get("REFDGS_CAPTURES", "").split(":") if text]
    others = {folder.name: folder for folder in given}
    flash = SHARED / "kettle_flash"
    return {"capture": SHARED / "kettle_capture", flash.name: flash, **others}


def cases() -> Iterator[Case]:
    """All of them; neighbours differ, so that a stopped batch is a fair sample."""
    for scene in SCENES:
        yield _steps(scene, 200)
    for scene in (*SCENES, "capture"):
        yield Case(f"{scene}-turned-1", scene, turned=1.0, settings={"train.iterations": 200})
    yield _steps("spheres", 600)
    yield _steps("kettle", 40)
    yield _steps("mug", 600)
    yield _whole("spheres", 2500)
    yield _whole("kettle", 1500)
    yield from _of_masks()
    yield _whole("mug", 1500)
    yield _whole("capture", 1500)
    yield _steps("kettle", 600)
    yield _steps("spheres", 40)
    yield _steps("mug", 40)
    yield from _of_photos()
    yield _steps("capture", 400)
    yield from _of_settings()
    yield _steps("spheres", 15)
    yield _steps("spheres", 1200)
    for turned in (4.0, 0.4):
        for scene in (*SCENES, "capture"):
            yield Case(f"{scene}-turned-{turned:g}", scene, turned=turned, settings=_SHORT)
    yield _steps("kettle", 1200)
    yield _steps("mug", 15)
    yield from _of_captures()


_SHORT = {"train.iterations": 120}


def _steps(scene: str, steps: int) -> Case:
    return Case(f"{scene}-{steps}", scene, settings={"train.iterations": steps})


def _whole(source: str, steps: int) -> Case:
    settings = {"train.iterations": steps}
    return Case(f"{source}-whole", source, 90, recipe="glossy", settings=settings, whole=True)


def _of_captures() -> Iterator[Case]:
    """Runs as users make them: photos without masks, as they are and damaged in turn."""
    damage: tuple[dict[str, Any], ...] = (
        {"views": 12},
        {"turned": 0.5},
        {"arc": 200.0},
        {"settings": {"masks.find": "off"}},
        {"settings": {"train.iterations": 100}},
    )
    names = ("few", "turned", "arc", "unmasked", "short")
    for source in captures():
        yield Case(f"{source}-preview", source, 90, whole=True)
    for i, source in enumerate(captures()):
        both = {"views": 90, **damage[i % len(damage)]}
        yield Case(f"{source}-preview-{names[i % len(names)]}", source, whole=True, **both)


def _of_masks() -> Iterator[Case]:
    for masks, scene in (("torn", "kettle"), ("mixed", "mug"), ("wide", "spheres")):
        yield Case(f"{scene}-masks-{masks}", scene, masks=masks, settings=_SHORT)
    yield Case("spheres-masks-mixed", "spheres", masks="mixed", settings=_SHORT)
    yield Case("mug-masks-narrow", "mug", masks="narrow", settings=_SHORT)
    yield Case("capture-masks", "capture", masks="given", settings={"train.iterations": 200})
    yield Case("capture-masks-torn", "capture", masks="torn", settings=_SHORT)


def _of_photos() -> Iterator[Case]:
    for views in (5, 11):
        for scene in (*SCENES, "capture"):
            yield Case(f"{scene}-{views}-photos", scene, views=views, settings=_SHORT)
    for scene in (*SCENES, "capture"):
        yield Case(f"{scene}-half-round", scene, arc=150.0, views=16, settings=_SHORT)


def _of_settings() -> Iterator[Case]:
    """Other meshes of the same fields, and a field that does not reflect."""
    many: dict[str, dict[str, Any]] = {
        "coarse": {"extract.voxel": 0.045},
        "melted": {"clean.smoothing": 200, "fit.outlines": 0},
        "angular": {"clean.faces": 150},
        "bits": {
            "extract.min_alpha": 0.05,
            "extract.min_views": 1,
            "clean.floater": 0.0,
            "clean.hole": 0.0,
        },
    }
    for i, (name, settings) in enumerate(many.items()):
        for scene in (SCENES[i % 3], SCENES[(i + 1) % 3]):
            both = {"train.iterations": 200, **settings}
            yield Case(f"{scene}-{name}", scene, settings=both, like=f"{scene}-200")
    for scene in ("spheres", "kettle"):
        yield Case(f"{scene}-matte", scene, recipe="matte", settings=_SHORT)


def settings_of(case: Case) -> dict[str, Any]:
    """Every setting of a case's run that is not the recipe's."""
    if case.whole:
        return case.settings
    extra = {"train.max_side": 400} if case.recipe != "preview" else {}
    wide = {"ingest.max_side": 160, "evaluate.max_side": 160} if case.source == "capture" else {}
    return {**CHEAP, **extra, **wide, **case.settings}


def write_case(case: Case, folder: Path) -> None:
    """The photos, masks and poses of a case, as a user would give them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if case.photos:
        _write_capture(case, folder)
    else:
        _write_scene(case, folder)


def truth_root(case: Case) -> Path:
    """Where the truth of a case lies."""
    return captures()[case.source] if case.photos else SHARED / "scenes" / case.source


def truth_frames(case: Case) -> list[dict[str, Any]]:
    """The frames that no case uses."""
    if case.photos:
        frames = _read(truth_root(case) / "cameras_gt.json")["frames"]
        return [f for i, f in enumerate(frames) if i % 12 == 7]
    frames = _read(truth_root(case) / "transforms_test.json")["frames"]
    return [frames[i] for i in _spread(len(frames), TRUTH, 0.5)]


def _write_scene(case: Case, folder: Path) -> None:
    root, wrong = truth_root(case), _Wrong(case.turned)
    taken = {f["file_path"] for f in truth_frames(case)}
    for split, count in (("train", case.views), ("test", TEST)):
        record = _read(root / f"transforms_{split}.json")
        frames = [f for f in record["frames"] if f["file_path"] not in taken]
        frames = [f for f in frames if _within(f["transform_matrix"], case.arc)]
        frames = [frames[i] for i in _spread(len(frames), count, 0.0)]
        (folder / split).mkdir()
        for i, frame in enumerate(frames):
            name = Path(frame["file_path"]).name + ".png"
            _write_photo(case, root / split / name, folder / split / name, i)
            frame["transform_matrix"] = wrong(frame["transform_matrix"])
        record["frames"] = frames
        (folder / f"transforms_{split}.json").write_text(json.dumps(record))
    shutil.copy(root / "gt_mesh.ply", folder)


def _write_capture(case: Case, folder: Path) -> None:
    root, wrong = truth_root(case), _Wrong(case.turned)
    record = _read(root / "cameras_gt.json")
    taken = {f["file"] for f in truth_frames(case)}
    frames = [f for f in record["frames"] if f["file"] not in taken]
    frames = [f for f in frames if _within(f["transform_matrix"], case.arc)]
    tests = frames[3::8]
    train = [f for f in frames if f not in tests]
    train = [train[i] for i in _spread(len(train), case.views, 0.0)]
    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    entries = []
    for i, frame in enumerate([*train, *tests]):
        shutil.copy(root / frame["file"], folder / "images")
        entry = {
            "file_path": frame["file"],
            "transform_matrix": wrong(frame["transform_matrix"]),
        }
        if case.masks:
            name = f"masks/{Path(frame['file']).stem}.png"
            mask = cv2.imread(str(root / name), cv2.IMREAD_GRAYSCALE)
            other = cv2.imread(str(root / "masks" / "IMG_0020.png"), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(folder / name), _damaged_mask(case.masks, mask, other, i))
            entry["mask_path"] = name
        entries.append(entry)
    lens = {"fl_x": record["fx"], "fl_y": record["fy"], "cx": record["cx"], "cy": record["cy"]}
    size = {"w": record["width"], "h": record["height"]}
    named = {"test_filenames": [f["file"] for f in tests], **size, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps({**lens, **named}))
    if not case.masks:
        (folder / "masks").rmdir()
    shutil.copy(root / "gt_mesh.ply", folder)


def _write_photo(case: Case, source: Path, target: Path, number: int) -> None:
    """A photo with its mask damaged; what was removed round the object becomes grey cloth."""
    if not case.masks:
        shutil.copy(source, target)
        return
    rgba = np.asarray(cv2.imread(str(source), cv2.IMREAD_UNCHANGED), np.float32) / 255
    noise = np.random.default_rng(number).random((10, 10, 3), np.float32)
    cloth = cv2.resize(0.3 + 0.3 * noise, rgba.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    alpha = rgba[..., 3:]
    color = rgba[..., :3] * alpha + cloth * (1 - alpha)
    mask = np.round(255 * alpha[..., 0]).astype(np.uint8)
    other = np.roll(mask[:, ::-1], 25, axis=1)
    damaged = _damaged_mask(case.masks, mask, other, number)
    out = np.concatenate([color, damaged[..., None] / 255], -1)
    cv2.imwrite(str(target), np.round(255 * np.clip(out, 0, 1)).astype(np.uint8))


def _damaged_mask(how: str, mask: Any, other: Any, number: int) -> Any:
    """A mask made wrong. `other` is that of another photo."""
    random = np.random.default_rng(100 + number)
    size = mask.shape[1] // 40 | 1
    kernel = np.ones((size, size), np.uint8)
    if how == "wide":
        return cv2.dilate(mask, kernel)
    if how == "narrow":
        return cv2.erode(mask, kernel)
    if how == "torn":  # a bite of another place in every second photo
        out = mask.copy()
        if number % 2:
            ys, xs = np.nonzero(mask > 127)
            at = random.integers(len(ys))
            cv2.circle(out, (int(xs[at]), int(ys[at])), mask.shape[1] // 7, 0, -1)
        return out
    if how == "mixed" and random.random() < 0.3:
        return other
    return mask


class _Wrong:
    """Poses turned about the object's centre, and a fifth as much about their own."""

    def __init__(self, degrees: float) -> None:
        self.degrees, self.random = degrees, np.random.default_rng(5)

    def __call__(self, matrix: list[list[float]]) -> list[list[float]]:
        pose = np.array(matrix, np.float64)
        pose = self._turn(self.degrees) @ pose @ self._turn(self.degrees / 5)
        return [[float(v) for v in row] for row in pose]

    def _turn(self, degrees: float) -> F64:
        out = np.eye(4)
        vector = self.random.normal(size=3) * np.radians(degrees) / np.sqrt(3)
        out[:3, :3] = cv2.Rodrigues(vector)[0]
        return out


def _within(matrix: list[list[float]], arc: float) -> bool:
    """Whether a camera stands in the first `arc` degrees round the object."""
    return float(np.degrees(np.arctan2(matrix[1][3], matrix[0][3])) % 360) <= arc


def _spread(total: int, count: int, first: float) -> list[int]:
    """`count` of `total` numbers, evenly."""
    count = min(count, total)
    return [int((i + first) * total / count) for i in range(count)]


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return record
