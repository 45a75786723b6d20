"""How well the verdict, which knows no truth, agrees with the truth: runs, table and plot.

    python tests/benchmarks/bench_verdict.py run FOLDER      # every case that is not done; hours
    python tests/benchmarks/bench_verdict.py score FOLDER    # evidence and truth of all that are
    python tests/benchmarks/bench_verdict.py report FOLDER docs   # docs/verdict_runs.csv, .svg

`run` may be stopped and started again, and several may work in one folder. It needs the scenes
with ground truth in ../shared/data. `report` needs only the table, and `report docs docs` draws
the committed one again.
"""

import csv
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from verdict_cases import Case, cases, settings_of, truth_frames, truth_root, write_case

from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.camera import Camera, opencv_from_opengl
from refdgs_pipe.evaluation.verdict import judged
from refdgs_pipe.metrics import psnr, rank_correlation

F32 = NDArray[np.float32]
TABLE = "verdict_runs.csv"
TRUE_FIGURES = ("chamfer", "true_psnr", "true_asset_psnr")
BAD_CHAMFER, BAD_PSNR = 2.0, 20.0  # % of the diagonal, dB: nothing worse may be called good


def run(folder: Path) -> None:
    """Make every case up to its textures."""
    import torch

    from refdgs_pipe.cli import workspace as spaces
    from refdgs_pipe.cli.running import Options, bring_up_to
    from refdgs_pipe.errors import RefdgsError

    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    for case in cases():
        if case.like and not (folder / f"{case.like}.json").exists():
            continue
        try:
            os.close(os.open(folder / f"{case.name}.lock", os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            continue
        photos = folder / (case.like or case.name)
        if case.like:
            shutil.copytree(folder / f"{case.like}.refdgs", folder / f"{case.name}.refdgs")
        else:
            write_case(case, photos)
        before, reason = sum(os.times()[:4]), ""
        sets = tuple(f"{key}={json.dumps(value)}" for key, value in settings_of(case).items())
        memory = spaces.Memory((photos.absolute(),), case.recipe, sets)
        space = spaces.open_workspace(folder / f"{case.name}.refdgs", memory)
        options = Options(until="bake", threads=1, device="cpu", verbosity=0)
        try:
            bring_up_to(space, options)
        except RefdgsError as error:
            reason = str(error)
        seconds = round(sum(os.times()[:4]) - before, 1)
        record = {"core_seconds": seconds, "failed": reason}
        (folder / f"{case.name}.json").write_text(json.dumps(record))
        print(case.name, seconds, reason, flush=True)


def score(folder: Path) -> None:
    """The evidence and the true errors of every case that is done and not scored yet."""
    for case in cases():
        made, out = folder / f"{case.name}.json", folder / f"{case.name}.figures.json"
        if not made.exists() or out.exists() or json.loads(made.read_text())["failed"]:
            continue
        begin = time.process_time()
        figures = figures_of(case, folder)
        out.write_text(json.dumps(figures))
        print(case.name, round(time.process_time() - begin, 1), figures, flush=True)


def figures_of(case: Case, folder: Path) -> dict[str, Any]:
    """The object's figures as the stage `evaluate` gathers it, and TRUE_FIGURES."""
    from refdgs_pipe.artifacts.appearance import Appearance
    from refdgs_pipe.artifacts.mesh import Mesh
    from refdgs_pipe.artifacts.sparse_model import SparseModel
    from refdgs_pipe.artifacts.surfel_field import SurfelField
    from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
    from refdgs_pipe.artifacts.views import Views
    from refdgs_pipe.cli import workspace as spaces
    from refdgs_pipe.evaluation.scoring import Drawing, Protocol, Subject, gathered
    from refdgs_pipe.relight import relit
    from refdgs_pipe.training.render import render_image, render_surface_map

    space = spaces.open_workspace(folder / f"{case.name}.refdgs")
    steps = [step for step in space.status() if step.origin and step.manifest]
    folders = {s.stage.output: space.pipeline.store.folder(s.origin) for s in steps if s.origin}

    def load(kind: Any) -> Any:
        return kind.load(folders[kind])

    field, views = load(SurfelField), load(Views)
    textured = load(TexturedMesh) if TexturedMesh in folders else None  # some stop at the mesh
    model = load(SparseModel).placed(field.poses, field.ball)
    drawing = Drawing(
        partial(render_image, field, threads=1),
        partial(render_surface_map, field, threads=1),
        None if textured is None else relit(textured, load(Appearance)),
    )
    subject = Subject(views, model, load(Mesh), folder, textured)
    evidence = gathered(subject, drawing, Protocol(space.settings["evaluate"].max_side))  # type: ignore[attr-defined]
    masked = views.background != "photo"
    return asdict(evidence) | _true_figures(case, subject.mesh, drawing, masked)


def _true_figures(case: Case, mesh: Any, drawing: Any, masked: bool) -> dict[str, Any]:
    """% of the diagonal; dB over the true object's pixels of photos that no case uses."""
    from refdgs_pipe.evaluation.surface import score_surface
    from refdgs_pipe.evaluation.truth import read_true_mesh

    name = "cameras_gt.json" if case.photos else "transforms_train.json"
    record = json.loads((truth_root(case) / name).read_text())
    around = [_camera(case, record, frame) for frame in record["frames"]][::2]
    truth = read_true_mesh(truth_root(case) / "gt_mesh.ply")
    found = score_surface(mesh, around, truth, among_others=case.photos and not masked)
    field, asset = [], []
    for frame in truth_frames(case):
        camera = _camera(case, record, frame)
        photo, there = _true_photo(case, camera, frame, masked)
        image = drawing.picture(camera)
        field.append(psnr(image[there], photo[there]))
        if drawing.relit is not None:
            drawn, alpha = drawing.relit(camera)
            over = drawn * alpha[..., None] + (1 if masked else image) * (1 - alpha[..., None])
            asset.append(psnr(over[there].astype(np.float32), photo[there]))
    return {
        "chamfer": None if found is None else found.percent(found.chamfer),
        "true_psnr": float(np.mean(field)),
        "true_asset_psnr": float(np.mean(asset)) if asset else None,
    }


def _camera(case: Case, record: dict[str, Any], frame: dict[str, Any]) -> Camera:
    pose = opencv_from_opengl(np.array(frame["transform_matrix"], float))
    if case.photos:
        K = np.array([[record["fx"], 0, record["cx"]], [0, record["fy"], record["cy"]], [0, 0, 1]])
        return Camera("true", record["width"], record["height"], K, pose).fitted(
            320 if case.whole else 160
        )
    focal = 160 / np.tan(record["camera_angle_x"] / 2)
    K = np.array([[focal, 0, 160.0], [0, focal, 160.0], [0, 0, 1.0]])
    return Camera("true", 320, 320, K, pose).fitted(320 if case.whole else 112)


def _true_photo(
    case: Case, camera: Camera, frame: dict[str, Any], masked: bool
) -> tuple[F32, NDArray[np.bool_]]:
    """The photo at the camera's size, over white if masked, and its object's pixels."""
    root = truth_root(case)
    if case.photos:
        photo = _read(root / frame["file"])[..., :3]
        mask = _read(root / "masks" / f"{Path(frame['file']).stem}.png")
        mask = mask if mask.ndim == 2 else mask[..., 0]
    else:
        rgba = _read(root / f"{frame['file_path']}.png")
        mask, photo = rgba[..., 3], rgba[..., :3]
        photo = photo * mask[..., None]
    size = (camera.width, camera.height)
    mask, photo = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (mask, photo))
    if not case.photos:
        photo = photo + (1 - mask[..., None])
    elif masked:
        photo = photo * mask[..., None] + (1 - mask[..., None])
    there = cv2.dilate((mask >= 0.5).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.asarray(photo, np.float32), there


def _read(path: Path) -> F32:
    """Pixels in [0, 1], red first."""
    pixels = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.float32) / np.float32(255)
    if pixels.ndim == 3:
        pixels[..., :3] = pixels[..., 2::-1]
    return pixels


def rows_of(folder: Path) -> Iterator[dict[str, Any]]:
    """The runs that are scored, those of the table if there is one."""
    table = folder / TABLE
    if table.exists():
        with table.open() as file:
            for row in csv.DictReader(file):
                yield {k: _value(v) for k, v in row.items()}
        return
    for i, case in enumerate(cases()):
        figures = folder / f"{case.name}.figures.json"
        if figures.exists():
            seconds = json.loads((folder / f"{case.name}.json").read_text())["core_seconds"]
            fixed = {"run": case.name, "held_out_run": i % 3 == 2, "core_seconds": seconds}
            yield fixed | json.loads(figures.read_text())


def _value(text: str) -> Any:
    if text in ("True", "False", ""):
        return {"True": True, "False": False, "": None}[text]
    try:
        return int(text) if text.lstrip("-").isdigit() else float(text)
    except ValueError:
        return text


def evidence_of(row: dict[str, Any]) -> ObjectFigures:
    """What a row of the table says without the truth."""
    known = [name for name in ObjectFigures.__dataclass_fields__ if name in row]
    return ObjectFigures(**{name: row[name] for name in known})


def agreement(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Spearman's correlations of the verdict's score with the truth, and how it sorted the runs."""
    verdicts = [judged(evidence_of(row)) for row in rows]
    scores = np.array([v.score for v in verdicts])
    truth = {name: np.array([row[name] or np.nan for row in rows], float) for name in TRUE_FIGURES}
    shape = -np.nan_to_num(truth["chamfer"], nan=1e3)
    picture = np.nan_to_num(truth["true_psnr"], nan=0.0)
    asset = truth["true_asset_psnr"]
    ranks = _ranks(shape) + _ranks(picture)
    bad = (shape < -BAD_CHAMFER) | (picture < BAD_PSNR)
    good = np.array([v.word == "good" for v in verdicts])
    lit = np.isfinite(asset)
    return {
        "runs": len(rows),
        "shape and picture": rank_correlation(scores, ranks) or 0.0,
        "shape (Chamfer)": rank_correlation(scores, shape) or 0.0,
        "picture (PSNR)": rank_correlation(scores, picture) or 0.0,
        "asset (PSNR, relit)": rank_correlation(scores[lit], asset[lit]) or 0.0,
        **{word: sum(v.word == word for v in verdicts) for word in ("good", "fair", "poor")},
        "truly bad": int(bad.sum()),
        "truly bad, called good": int((bad & good).sum()),
        "truly bad, called poor": int((bad & np.array([v.word == "poor" for v in verdicts])).sum()),
    }


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.stats import rankdata

    return np.asarray(rankdata(values))


def report(folder: Path, out: Path) -> None:
    """Write the table and the plot, and print how far verdict and truth agree."""
    rows = list(rows_of(folder))
    names = list(rows[0])
    with (out / TABLE).open("w", newline="") as file:
        table = csv.DictWriter(file, names)
        table.writeheader()
        for row in rows:
            table.writerow({k: _short(v) for k, v in row.items()})
    for title, some in (
        ("all", rows),
        ("thresholds were chosen on", [r for r in rows if not r["held_out_run"]]),
        ("held out", [r for r in rows if r["held_out_run"]]),
    ):
        print(title, {k: round(v, 3) for k, v in agreement(some).items()})
    (out / "verdict.svg").write_text(drawn(rows), "utf-8")


def _short(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value


COLORS = {"good": "#1b7f46", "fair": "#b7791f", "poor": "#b3261e"}


def drawn(rows: list[dict[str, Any]]) -> str:
    """The verdict's score against the true errors, as SVG."""
    axes = (
        ("chamfer", "Chamfer distance, % of the diagonal (log)", BAD_CHAMFER, True),
        ("true_psnr", "PSNR of the object in unused photos, dB", BAD_PSNR, False),
        ("true_asset_psnr", "PSNR of the relit asset there, dB", BAD_PSNR, False),
    )
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1080 400" '
        'font-family="sans-serif" font-size="12"><rect width="1080" height="400" fill="#fff"/>'
    ]
    for i, (name, label, limit, log) in enumerate(axes):
        parts += _panel(rows, name, label, limit, log, left=20 + i * 355)
    x = 60
    for word, color in COLORS.items():
        parts.append(f'<circle cx="{x}" cy="385" r="5" fill="{color}"/>')
        parts.append(f'<text x="{x + 10}" y="389">{word}</text>')
        x += 70
    parts.append(
        f'<text x="{x}" y="389">filled: thresholds chosen on; ring: held out of that. '
        "Across: the score of the verdict. Dashed: worse than this must not be good.</text>"
    )
    return "\n".join([*parts, "</svg>"])


def _panel(
    rows: list[dict[str, Any]], name: str, label: str, limit: float, log: bool, *, left: int
) -> list[str]:
    known = [(judged(evidence_of(r)), r) for r in rows if r[name] is not None]
    values = np.array([r[name] for _, r in known], float)
    scores = np.array([v.score for v, _ in known])
    change = np.log10 if log else np.asarray
    low, high = change(min(values.min(), limit) * 0.95), change(max(values.max(), limit) * 1.05)
    first, last = scores.min() - 0.1, scores.max() + 0.1

    def place(score: float, value: float) -> tuple[float, float]:
        x = left + 30 + 300 * (score - first) / (last - first)
        share = (float(change(value)) - low) / (high - low)
        return x, 20 + 320 * (share if log else 1 - share)

    out = [f'<rect x="{left + 30}" y="20" width="300" height="320" fill="none" stroke="#999"/>']
    y = place(first, limit)[1]
    out.append(f'<path d="M{left + 30} {y:.1f}h300" stroke="#555" stroke-dasharray="5 4"/>')
    ticks = [0.2, 0.5, 1, 2, 5, 10, 20] if log else list(range(8, 40, 4))
    for tick in ticks:
        y = place(first, tick)[1]
        if 20 <= y <= 340:
            out.append(f'<text x="{left + 26}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in np.arange(np.ceil(first * 2) / 2, last, 0.5):
        x = place(tick, limit)[0]
        out.append(f'<text x="{x:.1f}" y="356" text-anchor="middle">{tick:g}</text>')
    for verdict, row in known:
        x, y = place(verdict.score, row[name])
        color = COLORS[verdict.word]
        fill = "none" if row["held_out_run"] else color
        title = f"{row['run']}: {verdict.word}, {row[name]:.2f}"
        out.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{fill}" stroke="{color}" '
            f'stroke-width="1.5"><title>{title}</title></circle>'
        )
    out.append(f'<text x="{left + 180}" y="14" text-anchor="middle">{label}</text>')
    return out


if __name__ == "__main__":
    what, *places = sys.argv[1:] or ["help"]
    commands = {"run": run, "score": score, "report": report}
    if what not in commands or not places:
        sys.exit(__doc__)
    commands[what](*map(Path, places))
