"""The check as one JSON object."""

from dataclasses import asdict, dataclass
from typing import Any

from refdgs_pipe.checking.cost import Cost
from refdgs_pipe.checking.findings import Finding, Verdict
from refdgs_pipe.checking.look import Look
from refdgs_pipe.imaging.quality import blurred
from refdgs_pipe.sfm.around import Around, around

SCHEMA = 1


@dataclass(frozen=True)
class Checked:
    """All that a check found.

    Args:
        costs: of each recipe; empty where nothing could be read.
        cores: that the costs are for.
        seconds: that the check took.
    """

    look: Look
    findings: tuple[Finding, ...]
    verdict: Verdict
    costs: tuple[Cost, ...]
    cores: int
    seconds: float

    @property
    def around(self) -> Around | None:
        """The photos' directions from the object, where they have places."""
        return None if self.look.model is None else around(self.look.model)


def record(checked: Checked) -> dict[str, Any]:
    """Everything a check found, for programs; docs/check.md names the keys."""
    look, verdict = checked.look, checked.verdict
    return {
        "schema": SCHEMA,
        "verdict": verdict.word,
        "line": verdict.line,
        "to_do": list(verdict.to_do),
        "exit_code": verdict.exit_code,
        "is_preliminary": verdict.word == "unclear",
        "findings": [asdict(finding) for finding in checked.findings],
        "photos": _photos(look),
        "skipped": [asdict(file) for file in look.views.skipped] if look.views else [],
        "warnings": list(look.warnings),
        "known_poses": look.is_known,
        "placement": _placement(look),
        "coverage": _coverage(checked.around),
        "costs": _costs(checked),
        "seconds": round(checked.seconds, 1),
    }


def _photos(look: Look) -> list[dict[str, Any]]:
    """Each photo that was read, with its figures."""
    views = look.views
    if views is None:
        return []
    weak = set(blurred([view.sharpness for view in views.items]))
    lost = look.judgement.lost if look.judgement else {}
    taken = {view.name for view in look.tried}
    out = []
    for index, view in enumerate(views.items):
        exposure = look.exposures.get(view.name)
        out.append(
            {
                "name": view.source or view.name,
                "sharpness": round(view.sharpness, 2),
                "is_blurred": index in weak,
                "is_dark": exposure is not None and exposure.is_dark,
                "clipped": None if exposure is None else round(exposure.clipped, 4),
                "flash": view.exif.flash,
                "has_mask": view.mask is not None,
                "is_placed": look.is_known or (view.name in taken and view.name not in lost),
                "why_not": lost.get(view.name),
            }
        )
    return out


def _placement(look: Look) -> dict[str, Any] | None:
    judgement, placement = look.judgement, look.placement
    if judgement is None or placement is None:
        return None
    return {
        "is_trusted": judgement.is_trusted,
        "tried": len(look.tried),
        "trusted": len(look.tried) - len(judgement.lost),
        "points": 0 if placement.poses is None else len(placement.poses.points),
        "checks": [asdict(check) for check in judgement.checks],
        "gaps": list(judgement.gaps),
        "notes": list(placement.notes),
    }


def _coverage(found: Around | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "widest_gap_deg": round(found.gap_deg, 1),
        "lowest_deg": round(found.heights[0], 1),
        "highest_deg": round(found.heights[1], 1),
        "photos": [
            {"name": d.name, "azimuth_deg": round(d.azimuth, 1), "height_deg": round(d.height, 1)}
            for d in found.directions
        ],
    }


def _costs(checked: Checked) -> list[dict[str, Any]]:
    return [
        {
            "recipe": cost.recipe,
            "about_core_seconds": round(cost.core_seconds),
            "about_seconds": round(cost.seconds),
            "cores": checked.cores,
            "about_bytes": cost.bytes,
        }
        for cost in checked.costs
    ]
