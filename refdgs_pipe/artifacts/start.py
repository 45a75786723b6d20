"""What training starts with: the surfels, and what was found out about the object."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.errors import CorruptError

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Ground = Literal["background", "object"]
RawSet = Mapping[str, F32]
"""A set of surfels in optimised form: means (N, 3), quats (N, 4) w x y z, log_scales (N, 2),
raw_opacities (N,), and what they carry."""

SOLID, HOLLOW = 1, 2  # cells of `Start.vessel`
_SHAPES = {"means": 3, "quats": 4, "log_scales": 2, "raw_opacities": 0}
_SETS = ("geometry", "local", "background")


@dataclass(frozen=True, eq=False)
class Start:
    """Surfels to begin with, and the settings that training shares with the search for them.

    Args:
        geometry: carries raw_diffuse where the colours are known.
        local: for near-field reflections, throughout the ball.
        background: carries sh (N, 12); None where the photos' background was removed.
        faint: the geometry is spread where there may be nothing.
        covers: photo -> (h, w) how much of each pixel the object covers, 0 to 255, where a first
            look found it; empty else.
        ball: of the object.
        random: state of torch's generator for what the field draws when it is made.
        max_side: longest side of the photos, pixels.
        vessel: (n, n, n) cells of the hull's grid, SOLID or HOLLOW where a vessel was opened, 0
            elsewhere; None without a vessel.
        surfels, background_surfels: as asked for: geometry at the start, background at most.
        bfloat16: how the shader's network multiplies.
    """

    geometry: RawSet
    local: RawSet
    background: RawSet | None
    faint: bool
    covers: Mapping[str, U8]
    ball: Ball
    random: U8
    seed: int
    max_side: int
    ground: Ground
    surfels: int
    background_surfels: int
    bfloat16: bool
    vessel: U8 | None = None

    def limited(self, *, surfels: int, local: int, background: int) -> "Start":
        """With no more surfels than these in each set: every so many of them."""
        behind = self.background
        return replace(
            self,
            geometry=_thinned(self.geometry, surfels),
            local=_thinned(self.local, local),
            background=None if behind is None else _thinned(behind, background),
            surfels=min(self.surfels, surfels),
            background_surfels=min(self.background_surfels, background),
        )

    def save(self, folder: Path) -> None:
        from safetensors.numpy import save_file

        arrays: dict[str, NDArray[Any]] = {"random": self.random}
        for name in _SETS:
            for key, values in (getattr(self, name) or {}).items():
                arrays[f"{name}.{key}"] = np.ascontiguousarray(values, np.float32)
        if self.vessel is not None:
            arrays["vessel"] = np.ascontiguousarray(self.vessel)
        names = sorted(self.covers)
        for i, name in enumerate(names):
            arrays[f"cover.{i}"] = np.ascontiguousarray(self.covers[name])
        save_file(arrays, folder / "start.safetensors")
        record = {
            "background": self.background is not None,
            "faint": self.faint,
            "covers": names,
            "ball": {"center": self.ball.center.tolist(), "radius": self.ball.radius},
            **{key: getattr(self, key) for key in _SETTINGS},
        }
        (folder / "start.json").write_text(json.dumps(record, indent=2), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing, damaged, or does not fit.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            arrays = load_file(folder / "start.safetensors")
            record = json.loads((folder / "start.json").read_text("utf-8"))
            geometry, local = (_set(arrays, name) for name in ("geometry", "local"))
            center = np.array(record["ball"]["center"], np.float64)
            if record["ground"] not in get_args(Ground) or center.shape != (3,):
                raise ValueError("a setting is out of range")
            return cls(
                geometry=geometry,
                local=local,
                background=_set(arrays, "background") if record["background"] else None,
                faint=bool(record["faint"]),
                covers={name: arrays[f"cover.{i}"] for i, name in enumerate(record["covers"])},
                ball=Ball(center, float(record["ball"]["radius"])),
                random=arrays["random"],
                vessel=_vessel(arrays),
                **{key: record[key] for key in _SETTINGS},
            )
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CorruptError(
                f"{folder}: not a readable start ({error}): run the stage start again"
            ) from error


_SETTINGS = ("seed", "max_side", "ground", "surfels", "background_surfels", "bfloat16")


def _vessel(arrays: Mapping[str, NDArray[Any]]) -> U8 | None:
    cells = arrays.get("vessel")
    if cells is not None and (cells.dtype != np.uint8 or cells.shape != (len(cells),) * 3):
        raise ValueError("the vessel's cells are no cube")
    return cells


def _thinned(raw: RawSet, most: int) -> RawSet:
    count = len(raw["means"])
    if count <= most:
        return raw
    kept = np.arange(most) * count // most
    return {name: values[kept] for name, values in raw.items()}


def _set(arrays: Mapping[str, NDArray[Any]], name: str) -> dict[str, F32]:
    prefix = f"{name}."
    found = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    count = len(found["means"])
    for kind, width in _SHAPES.items():
        if found[kind].shape != ((count, width) if width else (count,)):
            raise ValueError(f"{name}.{kind} is {found[kind].shape} for {count} surfels")
    for kind, values in found.items():
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError(f"{name}.{kind} has the wrong length or is not finite")
    return found
