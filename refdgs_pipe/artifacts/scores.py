"""How good a result is, view by view."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self


@dataclass(frozen=True)
class ViewScore:
    """One view against its photo: PSNR in dB and SSIM."""

    name: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Scores:
    """All scored views.

    Args:
        split: "test" for held-out views; "train" when none was held out.
    """

    split: str
    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean over views, dB."""
        return sum(v.psnr for v in self.views) / max(1, len(self.views))

    @property
    def ssim(self) -> float:
        """Mean over views."""
        return sum(v.ssim for v in self.views) / max(1, len(self.views))

    def save(self, folder: Path) -> None:
        record = {"split": self.split, "psnr": self.psnr, "ssim": self.ssim}
        views = [asdict(view) for view in self.views]
        text = json.dumps({**record, "views": views}, indent=2)
        (folder / "scores.json").write_text(text, "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        record = json.loads((folder / "scores.json").read_text("utf-8"))
        return cls(record["split"], tuple(ViewScore(**view) for view in record["views"]))
