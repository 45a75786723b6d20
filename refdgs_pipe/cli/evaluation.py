"""The scores of a workspace, for people and for programs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.running import Options, bring_up_to
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.formatting import duration
from refdgs_pipe.pipeline.plan import Step

STAGE = "evaluate"
# figure -> label, unit, digits, remark
VIEW_ROWS = {
    "psnr": ("PSNR", "dB", 2, "over white, all channels at once"),
    "psnr_per_channel": ("PSNR by channel", "dB", 2, "the paper's: mean of the channels' own"),
    "ssim": ("SSIM", "", 4, ""),
    "lpips": ("LPIPS", "", 4, "VGG, fed with [0, 1] as the paper does"),
    "normal_mae_deg": ("normal error", "degrees", 2, "the paper's: all pixels, over white"),
    "normal_mae_foreground_deg": ("normal error", "degrees", 2, "the object's pixels"),
    "depth_mae": ("depth error", "units", 5, "where both have a surface"),
    "alpha_iou": ("alpha IoU", "", 4, ""),
    "relit_psnr": ("PSNR, relit", "dB", 2, "of the textured mesh in its own light"),
    "object_psnr": ("PSNR, object", "dB", 2, "the object's pixels"),
    "relit_object_psnr": ("  of it, relit", "dB", 2, "the same of the textured mesh"),
}
MATERIAL_ROWS = {
    "base_color_rmse": ("base colour", 4, "linear, scale-invariant RMSE"),
    "roughness_rank": ("roughness order", 3, "rank correlation over the materials"),
    "metallic_right": ("metal", 3, "share of the texels told right"),
}
SURFACE_ROWS = {
    "paper_chamfer": ("Chamfer distance", "the paper's: points seen"),
    "chamfer": ("Chamfer distance", "between the surfaces, where seen"),
    "accuracy": ("  mesh to truth", "accuracy"),
    "completeness": ("  truth to mesh", "completeness"),
    "median_accuracy": ("  mesh to truth", "median"),
    "median_completeness": ("  truth to mesh", "median"),
    "worst_accuracy": ("  mesh to truth", "in the worst part"),
    "worst_completeness": ("  truth to mesh", "in the worst part"),
}


def open_for_scores(root: Path, lpips_weights: Path | None) -> Workspace:
    """The workspace, with the weights of LPIPS among its settings if they are given.

    Raises:
        InputError: it is not a workspace, or the weights cannot be read.
    """
    memory = spaces.remembered(root, None, ())
    if lpips_weights is not None:
        from refdgs_pipe.evaluation.lpips import digest_of

        given = {
            "evaluate.lpips_weights": str(spaces.absolute(lpips_weights)),
            "evaluate.lpips_digest": digest_of(lpips_weights),
        }
        kept = [text for text in memory.assignments if text.partition("=")[0].strip() not in given]
        added = [f"{key}={json.dumps(value)}" for key, value in given.items()]
        memory = replace(memory, assignments=(*kept, *added))
    return spaces.open_workspace(root, memory)


def evaluate(space: Workspace, options: Options) -> dict[str, Any]:
    """Make the scores, and what is missing for them, and return them as JSON has them."""
    bring_up_to(space, replace(options, until=STAGE))
    step, folder = space.result(STAGE)
    scores = Scores.load(folder)
    assert step.manifest is not None
    measures = {name: value for name, value, _ in step.manifest.measures}
    return {
        "workspace": str(space.root),
        "scores": scores.record(),
        "speed": {
            "views_per_second": measures.get("render rate"),
            "rendered": measures.get("rendered"),
        },
        "seconds": _seconds(space.status()),
    }


def describe(record: dict[str, Any]) -> str:
    """The scores as a table in plain text."""
    scores, speed = record["scores"], record["speed"]
    notes, mean, surface = scores["notes"], scores["mean"], scores["surface"]
    kind = "held-out" if scores["split"] == "test" else "training (none was held out)"
    rows = [("views", f"{len(scores['views'])} {kind}", "")]
    for figure, (label, unit, digits, remark) in VIEW_ROWS.items():
        rows.append(_row(label, mean[figure], unit, digits, remark, notes.get(figure)))
    if surface is None:
        rows.append(_row("Chamfer distance", None, "", 0, "", notes.get("surface")))
    else:
        rows += _surface_rows(surface, notes)
    rows += _material_rows(scores["materials"], notes)
    rate = speed["views_per_second"]
    rows.append(_row("render rate", rate, "views/s", 2, speed["rendered"] or "", None))
    surfels = ", ".join(f"{count} {name}" for name, count in scores["surfels"].items())
    rows.append(("surfels", surfels, ""))
    rows += [(f"{stage} took", duration(s), "") for stage, s in record["seconds"].items()]
    width, middle = (max(len(row[i]) for row in rows if row[2] or i == 0) for i in (0, 1))
    return "\n".join(f"{a:{width}}  {b:{middle}}  {c}".rstrip() for a, b, c in rows)


def _surface_rows(surface: dict[str, Any], notes: dict[str, str]) -> list[tuple[str, str, str]]:
    rows = []
    for figure, (label, remark) in SURFACE_ROWS.items():
        share = surface[f"{figure}_percent"]
        words = remark if share is None else f"{share:.3f} % of the diagonal; {remark}"
        note = notes.get(figure, notes.get("chamfer"))
        rows.append(_row(label, surface[figure], "units", 5, words, note))
    for figure, part in (("f_score_half_percent", "0.5 %"), ("f_score_one_percent", "1 %")):
        words = f"share within {part} of the diagonal"
        rows.append(_row("F-score", surface[figure], "", 4, words, notes.get("chamfer")))
    if surface["left_out"]:
        words = "share of the mesh that lies too far off to count"
        rows.append(_row("  left out", surface["left_out"], "", 4, words, None))
    if surface["confidence_rank"] is not None:
        words = "rank correlation of low confidence and large distance; 1 is best"
        rows.append(_row("confidence", surface["confidence_rank"], "", 3, words, None))
    return rows


def _material_rows(
    found: dict[str, Any] | None, notes: dict[str, str]
) -> list[tuple[str, str, str]]:
    if found is None:
        return [_row("materials", None, "", 0, "", notes.get("materials"))]
    rows = [
        _row(label, found[figure], "", digits, remark, None)
        for figure, (label, digits, remark) in MATERIAL_ROWS.items()
    ]
    for part in found["parts"]:
        words = (
            f"truth {part['true_roughness']:.2f}, error {part['roughness_mae']:.2f}; "
            f"metal {part['metallic_right']:.0%} right, truth {part['true_metallic']:.0f}"
        )
        rows.append((f"  {part['name']}", f"roughness {part['roughness']:.2f}", words))
    return rows


def _row(
    label: str, value: float | None, unit: str, digits: int, remark: str, note: str | None
) -> tuple[str, str, str]:
    if value is None:
        return label, f"not computed: {note}" if note else "not computed", ""
    text = f"{value:.{digits}f} {unit}".rstrip()
    return label, text, "; ".join(part for part in (remark, note) if part)


def _seconds(steps: list[Step]) -> dict[str, float]:
    """How long each stage's current result took to make; adopted ones took none."""
    return {step.stage.name: round(step.manifest.seconds, 3) for step in steps if step.manifest}
