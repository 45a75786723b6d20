"""What was written and how it was made: files and their checks, scores, stages, settings."""

import hashlib
import json
from pathlib import Path

from refdgs_pipe.artifacts.asset import Asset, AssetFile
from refdgs_pipe.artifacts.scores import VIEW_FIGURES, Scores
from refdgs_pipe.formatting import counted, duration, figure, size
from refdgs_pipe.reporting import meanings, plots
from refdgs_pipe.reporting.facts import Drawing, Facts, Result
from refdgs_pipe.reporting.html import Content, Html, joined, table, tag
from refdgs_pipe.stage_words import doing

_LABELS = {
    "psnr": ("PSNR", "dB", 2),
    "psnr_per_channel": ("PSNR by channel", "dB", 2),
    "ssim": ("SSIM", "", 4),
    "lpips": ("LPIPS", "", 4),
    "normal_mae_deg": ("normal error, all pixels", "degrees", 2),
    "normal_mae_foreground_deg": ("normal error, object", "degrees", 2),
    "depth_mae": ("depth error", "units", 5),
    "alpha_iou": ("alpha IoU", "", 4),
    "relit_psnr": ("PSNR, relit", "dB", 2),
    "object_psnr": ("PSNR, object", "dB", 2),
    "relit_object_psnr": ("PSNR, object, relit", "dB", 2),
}
_SURFACE = {
    "paper_chamfer": "Chamfer distance, points seen",
    "chamfer": "Chamfer distance, surfaces",
    "accuracy": "mesh to truth",
    "completeness": "truth to mesh",
    "median_accuracy": "mesh to truth, median",
    "median_completeness": "truth to mesh, median",
    "worst_accuracy": "mesh to truth, worst part",
    "worst_completeness": "truth to mesh, worst part",
}


def scores(facts: Facts, _: Drawing) -> Html:
    """The evaluation's figures: means, the surface's, and each view's."""
    found = facts.load(Scores)
    kind = "kept for testing" if found.split == "test" else "used for learning (none was kept)"
    rows: list[tuple[Content, ...]] = []
    absent: dict[str, list[str]] = {}  # reason -> labels
    for name in VIEW_FIGURES:
        label, unit, digits = _LABELS.get(name, (name, "", 4))
        value = found.mean(name)
        if value is None:
            absent.setdefault(facts.plain(found.notes.get(name, "")), []).append(label)
        else:
            meaning = meanings.SCORES.get(name, "")
            rows.append((label, f"{value:.{digits}f} {unit}".rstrip(), meaning))
    rows += _surface(found)
    rows += _materials(found)
    for name, label in (("surface", "distance to the true surface"), ("materials", "materials")):
        if getattr(found, name) is None:
            absent.setdefault(facts.plain(found.notes.get(name, "")), []).append(label)
    used = [n for n in VIEW_FIGURES if any(getattr(view, n) is not None for view in found.views)]
    views = [
        (view.name, *(_cell(getattr(view, name), _LABELS[name][2]) for name in used))
        for view in sorted(found.views, key=lambda view: view.psnr)
    ]
    names = tuple(_LABELS[name][0] for name in used)
    each = tag("details", tag("summary", "Each photo"), table(("photo", *names), list(views)))
    words = f"Means over {counted(len(found.views), 'photo')} {kind}."
    figures = table(("figure", "value", "what it means"), rows, class_="meant")
    return joined(tag("p", words), figures, _absent(absent), _parts(found), each)


def _absent(absent: dict[str, list[str]]) -> Html:
    """What was not measured: one line for each reason."""
    lines = [
        tag("li", ", ".join(labels), f": {reason}" if reason else "")
        for reason, labels in absent.items()
    ]
    return joined(tag("p", "Not measured:"), tag("ul", *lines)) if lines else Html("")


def _materials(found: Scores) -> list[tuple[Content, ...]]:
    score = found.materials
    if score is None:
        return []
    rank = "all alike" if score.roughness_rank is None else f"{score.roughness_rank:.3f}"
    values = {
        "base colour": f"{score.base_color_rmse:.4f}",
        "roughness order": rank,
        "metal told right": f"{score.metallic_right:.1%}",
    }
    return [(name, value, meanings.MATERIALS[name]) for name, value in values.items()]


def _parts(found: Scores) -> Html:
    """The parts of the object whose true materials are known."""
    if found.materials is None:
        return Html("")
    head = ("part", "roughness", "true", "mean error", "metal", "true", "told right")
    rows: list[tuple[Content, ...]] = [
        (
            part.name,
            f"{part.roughness:.2f}",
            f"{part.true_roughness:.2f}",
            f"{part.roughness_mae:.2f}",
            f"{part.metallic:.2f}",
            f"{part.true_metallic:.0f}",
            f"{part.metallic_right:.0%}",
        )
        for part in found.materials.parts
    ]
    return table(head, rows)


def _surface(found: Scores) -> list[tuple[Content, ...]]:
    surface = found.surface
    if surface is None:
        return []
    rows: list[tuple[Content, ...]] = []
    for name, label in _SURFACE.items():
        percent = surface.percent(getattr(surface, name))
        words = "not computed" if percent is None else f"{percent:.3f} %"
        rows.append((label, words, meanings.SURFACE))
    for name, part in (("f_score_half_percent", "0.5 %"), ("f_score_one_percent", "1 %")):
        value = getattr(surface, name)
        words = "not computed" if value is None else f"{value:.4f}"
        rows.append((f"F-score, {part}", words, meanings.F_SCORE))
    if surface.left_out:
        rows.append(("left out, too far off", f"{surface.left_out:.1%}", meanings.LEFT_OUT))
    if surface.confidence_rank is not None:
        rows.append(("order of confidence", f"{surface.confidence_rank:.3f}", meanings.CONFIDENCE))
    return rows


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def files(facts: Facts, _: Drawing) -> Html:
    """The exported files, and what the validators say of them as they lie there now."""
    found, folder = facts.load(Asset), facts.folder(Asset)
    rows: list[tuple[Content, ...]] = []
    for file in found.files:
        faults = _faults(folder, file)
        verdict = tag("b", "bad" if faults else "ok", class_="bad" if faults else "ok")
        told = joined(verdict, f" {'; '.join(faults[:3])}") if faults else verdict
        rows.append((file.name, size(file.bytes), told, _checks(file.name)))
    words = "Each file was read again and checked as it lies in the folder now."
    return joined(tag("p", words), table(("file", "size", "check", "what was checked"), rows))


def _faults(folder: Path, file: AssetFile) -> list[str]:
    from refdgs_pipe.export.validate import glb_faults, usd_faults

    path = folder / file.name
    if not path.is_file():
        return ["missing"]
    if hashlib.sha256(path.read_bytes()).hexdigest() != file.sha256:
        return ["changed since it was written"]
    if path.suffix == ".glb":
        return glb_faults(path)
    return usd_faults(path) if path.suffix in (".usda", ".usdc", ".usdz") else []


def _checks(name: str) -> str:
    if name.endswith(".glb"):
        return "hash; structure, buffers, unit normals and tangents, bounds"
    if name.endswith((".usda", ".usdc", ".usdz")):
        return "hash; USD's validators, up axis, unit" + (
            ", package for AR" if name.endswith(".usdz") else ""
        )
    return "hash"


def stages(facts: Facts, _: Drawing) -> Html:
    """How long each stage took, and whether the last run made or reused it."""
    rows: list[tuple[Content, ...]] = []
    lengths = []
    figures: list[tuple[Content, ...]] = []
    for result in facts.results:
        when, kind = _cache(facts, result)
        made = result.manifest
        took = duration(made.seconds) if made else ""
        key = made.origin.key if made else ""
        rows.append((result.name, doing(result.name), took, when, tag("code", key)))
        lengths.append((result.name, made.seconds if made else 0.0, f"{took} {kind}", kind))
        figures += [
            (
                f"{result.name}: {name}",
                facts.plain(f"{figure(value)} {unit}".rstrip()),
                meanings.measured(name),
            )
            for name, (value, unit) in result.measures.items()
        ]
    hits = sum(kind == "reused" for _, _, _, kind in lengths)
    every = table(("figure", "value", "what it means"), figures, class_="meant")
    return joined(
        tag("p", f"The last run reused {hits} of {len(rows)} results, and made the others."),
        plots.bars(lengths),
        table(("stage", "what it does", "took", "made", "key"), rows),
        tag("details", tag("summary", "Every figure of every stage"), every),
    )


def _cache(facts: Facts, result: Result) -> tuple[str, str]:
    if result.manifest is None:
        return f"never run: {facts.plain(result.step.reason)}", "missing"
    if not result.is_current:
        return f"from an older run: {facts.plain(result.step.reason)}", "stale"
    if result.manifest.note:
        return f"adopted from {result.manifest.note}", "adopted"
    is_made = result.name in facts.notes.made
    made = result.manifest.made_utc.replace("T", " ").removesuffix("Z") + " UTC"
    when = made if is_made else f"reused; made {made}"
    return when, "made" if is_made else "reused"


def settings(facts: Facts, _: Drawing) -> Html:
    """The recipe, what was set by hand, and every setting."""
    changed = ", ".join(facts.changed) or "nothing"
    rows: list[tuple[Content, ...]] = [
        (
            f"{stage}.{key}",
            facts.plain(json.dumps(value, ensure_ascii=False)),
            _described(facts, stage, key),
        )
        for stage, group in facts.settings.items()
        for key, value in group.items()
    ]
    words = tag(
        "p", "Recipe ", tag("b", facts.recipe), "; set by hand: ", facts.plain(changed), "."
    )
    head = ("setting", "value", "what it means")
    every = tag("details", tag("summary", "Every setting"), table(head, rows, class_="meant"))
    programs = {
        name: version
        for result in facts.results
        if result.manifest
        for name, version in result.manifest.origin.programs.items()
    }
    used = ", ".join(f"{name} {version}" for name, version in sorted(programs.items()))
    return joined(
        words, tag("p", f"Libraries that the results depend on: {used or 'none'}."), every
    )


def _described(facts: Facts, stage: str, key: str) -> str:
    """What a setting means, as its declaration says."""
    for result in facts.results:
        if result.name == stage:
            info = result.step.stage.params.model_fields.get(key)
            return str(info.description or "") if info is not None else ""
    return ""
