"""How good a result is: its views against photos and truth, its mesh against the true surface."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.errors import CorruptError


@dataclass(frozen=True)
class ViewScore:
    """One view. docs/evaluation.md has the protocols; None: could not be computed.

    Args:
        psnr, psnr_per_channel: dB; of all channels at once, and the mean of the channels' own.
        ssim, lpips: similarity (1 is best) and distance (0 is best).
        normal_mae_deg: mean angle in degrees over all pixels, normals over white.
        normal_mae_foreground_deg: mean angle in degrees over the object's pixels.
        depth_mae: mean absolute difference of depth, world units, where both have a surface.
        alpha_iou: intersection over union of the masks alpha >= 0.5.
        relit_psnr: dB; of the textured mesh in its own environment instead of the field.
        object_psnr, relit_object_psnr: the same as `psnr` and `relit_psnr`, over the object's
            pixels alone.
    """

    name: str
    psnr: float
    psnr_per_channel: float
    ssim: float
    lpips: float | None = None
    normal_mae_deg: float | None = None
    normal_mae_foreground_deg: float | None = None
    depth_mae: float | None = None
    alpha_iou: float | None = None
    relit_psnr: float | None = None
    object_psnr: float | None = None
    relit_object_psnr: float | None = None


VIEW_FIGURES = tuple(name for name in ViewScore.__dataclass_fields__ if name != "name")


@dataclass(frozen=True)
class SurfaceScore:
    """The fitted mesh against the true surface; lengths in world units. None: not computed.

    Args:
        diagonal: of the true surface's bounding box; the unit of every `_percent`.
        paper_chamfer: between points that the training cameras see.
        chamfer, accuracy, completeness: between surfaces, where training cameras see them.
        f_score_half_percent, f_score_one_percent: share within that part of the diagonal, 0 to 1.
        median_accuracy, median_completeness: medians where accuracy and completeness are means.
        worst_accuracy, worst_completeness: the means in the worst part of the surface, of parts as
            large as a tenth of the diagonal.
        left_out: share of the mesh's points that lie too far off and do not count, where the mesh
            may hold more than the object.
        confidence_rank: Spearman's correlation of low confidence and large distance from the
            truth, over the mesh; 1: the mesh is further off wherever confidence is lower.
    """

    diagonal: float
    paper_chamfer: float | None = None
    chamfer: float | None = None
    accuracy: float | None = None
    completeness: float | None = None
    f_score_half_percent: float | None = None
    f_score_one_percent: float | None = None
    median_accuracy: float | None = None
    median_completeness: float | None = None
    worst_accuracy: float | None = None
    worst_completeness: float | None = None
    left_out: float | None = None
    confidence_rank: float | None = None

    def percent(self, length: float | None) -> float | None:
        """A length in percent of the diagonal."""
        return None if length is None else 100 * length / self.diagonal


@dataclass(frozen=True)
class PartScore:
    """One part of the object whose true material is known.

    Args:
        texels: how many of it were compared.
        roughness, metallic: medians of its texels; true_roughness, true_metallic: of the truth.
        roughness_mae: mean absolute difference.
        metallic_right: share of its texels on the right side of one half.
    """

    name: str
    texels: int
    roughness: float
    true_roughness: float
    roughness_mae: float
    metallic: float
    true_metallic: float
    metallic_right: float


@dataclass(frozen=True)
class MaterialScore:
    """The textures against the true materials, over the texels that the views' pixels show.

    Args:
        base_color_rmse: linear RGB, scale-invariant.
        roughness_rank: Spearman's correlation with the truth over the materials; None: all alike.
        metallic_right: share of all texels on the right side of one half.
    """

    base_color_rmse: float
    roughness_rank: float | None
    metallic_right: float
    parts: tuple[PartScore, ...]


@dataclass(frozen=True)
class Scores:
    """All scored views, and the surface.

    Args:
        split: "test" for held-out views; "train" when none was held out.
        surface, materials: None when there is no truth to compare with.
        surfels: part of the field -> how many it has.
        notes: figure -> why it was not computed, or what it leaves out.
        evidence: what the verdict is made of; None where it was not gathered.
    """

    split: str
    views: tuple[ViewScore, ...]
    surface: SurfaceScore | None = None
    surfels: dict[str, int] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    materials: MaterialScore | None = None
    evidence: ObjectFigures | None = None

    def mean(self, figure: str) -> float | None:
        """The mean of one of VIEW_FIGURES over the views that have it; None if none has."""
        values = [getattr(view, figure) for view in self.views]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    @property
    def psnr(self) -> float:
        """Mean over views, dB; 0 without views."""
        return self.mean("psnr") or 0.0

    @property
    def ssim(self) -> float:
        """Mean over views; 0 without views."""
        return self.mean("ssim") or 0.0

    def headlines(self) -> list[tuple[str, float, str]]:
        """(name, rounded value, unit) of the figures that say most; those that are known."""
        kind = "held-out" if self.split == "test" else "training"
        surface = self.surface
        chamfer = None if surface is None else surface.percent(surface.chamfer)
        found = [
            (f"PSNR of {kind} views", self.mean("psnr"), 2, "dB"),
            (f"SSIM of {kind} views", self.mean("ssim"), 4, ""),
            ("normal error", self.mean("normal_mae_deg"), 2, "degrees, all pixels"),
            ("Chamfer distance", chamfer, 3, "% of the diagonal"),
            ("PSNR of the relit asset", self.mean("relit_psnr"), 2, "dB"),
            *self._material_headlines(),
        ]
        return [(name, round(v, digits), unit) for name, v, digits, unit in found if v is not None]

    def _material_headlines(self) -> list[tuple[str, float | None, int, str]]:
        found = self.materials
        if found is None:
            return []
        return [
            ("base colour error", found.base_color_rmse, 4, "linear, scale-invariant RMSE"),
            ("roughness rank correlation", found.roughness_rank, 3, ""),
            ("metal told right", found.metallic_right, 3, "share of the texels"),
        ]

    def record(self) -> dict[str, Any]:
        """Everything as JSON has it, with the means and percentages that `load` leaves out."""
        surface = None
        if self.surface is not None:
            others = (
                "diagonal",
                "f_score_half_percent",
                "f_score_one_percent",
                "left_out",
                "confidence_rank",
            )
            lengths = [name for name in asdict(self.surface) if name not in others]
            percent = {
                f"{name}_percent": self.surface.percent(getattr(self.surface, name))
                for name in lengths
            }
            surface = asdict(self.surface) | percent
        return {
            "split": self.split,
            "mean": {name: self.mean(name) for name in VIEW_FIGURES},
            "surface": surface,
            "materials": None if self.materials is None else asdict(self.materials),
            "evidence": None if self.evidence is None else asdict(self.evidence),
            "surfels": self.surfels,
            "notes": self.notes,
            "views": [asdict(view) for view in self.views],
        }

    def save(self, folder: Path) -> None:
        text = json.dumps(self.record(), indent=2, allow_nan=False)
        (folder / "scores.json").write_text(text, "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: the file is missing or damaged.
        """
        try:
            record = json.loads((folder / "scores.json").read_text("utf-8"))
            surface = record["surface"]
            if surface is not None:
                known = {name: surface[name] for name in SurfaceScore.__dataclass_fields__}
                surface = SurfaceScore(**known)
            views = tuple(ViewScore(**view) for view in record["views"])
            materials = record["materials"]
            if materials is not None:
                parts = tuple(PartScore(**part) for part in materials["parts"])
                materials = MaterialScore(**{**materials, "parts": parts})
            evidence = record["evidence"]
            if evidence is not None:
                evidence = ObjectFigures(**evidence)
            surfels, notes = record["surfels"], record["notes"]
            return cls(record["split"], views, surface, surfels, notes, materials, evidence)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise CorruptError(f"{folder / 'scores.json'}: {error}") from None
