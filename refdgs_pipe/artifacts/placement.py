"""Where structure from motion put the photos, and what speaks for and against each place."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.errors import CorruptError

I32 = NDArray[np.int32]
_UNREADABLE = (OSError, EOFError, BadZipFile)


@dataclass(frozen=True)
class Evidence:
    """What the features of all photos say, placed or not. Row i of an array is `names[i]`.

    Args:
        names: file names, sorted.
        features: (n,) features found in each photo.
        still: (n,) share of a photo's matches that stand still in the picture while others move.
        moves: (n,) how far a photo's place moves when the others alone give its points, as a share
            of its distance to them; NaN for photos without a place.
        pairs: (m, 2) rows of two photos that were matched.
        matches: (m,) features matched by their look alone.
        inliers: (m,) of these, matches that one motion between the two photos explains.
        agree: (m,) share of the inliers that the found places explain; NaN where one has no place.
        shared: (m,) points of the model that both photos see.
        held: (m,) whether the mapper did not get this pair.
        angle: (m,) median angle between the two rays to the shared points, degrees; NaN for none.
    """

    names: tuple[str, ...]
    features: I32
    still: F64
    moves: F64
    pairs: I32
    matches: I32
    inliers: I32
    agree: F64
    shared: I32
    held: NDArray[np.bool_]
    angle: F64


@dataclass(frozen=True)
class Poses:
    """What was reconstructed, in the frame of the structure from motion.

    Args:
        cam_from_world: file name -> (4, 4).
        lens_of: file name -> index into `lenses`.
        lenses: COLMAP model name, width, height and parameters of each lens.
        points: (P, 3); colors: (P, 3) uint8; tracks: file name -> point indices.
        error_px: mean reprojection error.
        mapper: "incremental", "global", "mat" or "pattern".
        evidence: None where places do not come from features.
        rival: median distance between the photos' places here and in another solution from the
            same matches, as a share of the photos' distance from their middle; None without one.
        by_mat: files that were placed by the printed mat, in a frame that features gave.
    """

    cam_from_world: dict[str, F64]
    lens_of: dict[str, int]
    lenses: tuple[tuple[str, int, int, F64], ...]
    points: F64
    colors: NDArray[np.uint8]
    tracks: dict[str, NDArray[np.int64]]
    error_px: float
    mapper: str
    evidence: Evidence | None = None
    rival: float | None = None
    by_mat: tuple[str, ...] = ()


@dataclass(frozen=True)
class Attempt:
    """One way of placing the photos that was tried, and how far it came.

    Args:
        name: what was tried, in words.
        placed, trusted: photos; points: of the sparse model.
    """

    name: str
    placed: int
    trusted: int
    points: int


@dataclass(frozen=True)
class Placement:
    """The best that structure from motion found; judged by the stage `gate`.

    Args:
        poses: None if nothing was found, or if the capture came with poses.
        attempts: what was tried, in order.
        notes: what was found out on the way, in sentences, such as a background that stands still.
        known: whether the capture came with poses.
        metres_per_unit: length of a unit of `poses`, where something told it, else None.
        up: (3,) unit vector in the frame of `poses`, where something told it, else None.
        repeats: whether the ground repeats, as checks, tiles or dots do.
    """

    poses: Poses | None
    attempts: tuple[Attempt, ...] = ()
    notes: tuple[str, ...] = ()
    known: bool = False
    metres_per_unit: float | None = None
    up: F64 | None = None
    repeats: bool = False

    def save(self, folder: Path) -> None:
        """Write placement.json, and the arrays to placement.npz."""
        folder.mkdir(parents=True, exist_ok=True)
        record: dict[str, Any] = {
            "attempts": [asdict(attempt) for attempt in self.attempts],
            "notes": list(self.notes),
            "known": self.known,
            "metres_per_unit": self.metres_per_unit,
            "up": None if self.up is None else self.up.tolist(),
            "repeats": self.repeats,
        }
        if self.poses is not None:
            record["poses"] = _to_json(self.poses)
            np.savez(folder / "placement.npz", allow_pickle=False, **_arrays(self.poses))
        (folder / "placement.json").write_text(json.dumps(record, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged.
        """
        try:
            record = json.loads((folder / "placement.json").read_text(encoding="utf-8"))
            poses = None
            if "poses" in record:
                with np.load(folder / "placement.npz", allow_pickle=False) as data:
                    poses = _from_json(record["poses"], dict(data))
            return cls(
                poses=poses,
                attempts=tuple(Attempt(**a) for a in record["attempts"]),
                notes=tuple(record["notes"]),
                known=record["known"],
                metres_per_unit=record["metres_per_unit"],
                up=None if record["up"] is None else np.array(record["up"], float),
                repeats=record.get("repeats", False),
            )
        except (*_UNREADABLE, ValueError, KeyError, IndexError, TypeError) as error:
            raise CorruptError(f"{folder / 'placement.json'}: {error}") from None


_EVIDENCE = tuple(f.name for f in fields(Evidence) if f.name != "names")


def _arrays(poses: Poses) -> dict[str, NDArray[Any]]:
    """The large parts. Tracks stand one after another; `track_ends` tells where each ends."""
    files = list(poses.cam_from_world)
    tracks = [poses.tracks.get(file, np.zeros(0, np.int64)) for file in files]
    arrays: dict[str, NDArray[Any]] = {
        "poses": np.array([poses.cam_from_world[f] for f in files], float).reshape(-1, 4, 4),
        "points": poses.points,
        "colors": poses.colors,
        "tracks": np.concatenate([np.zeros(0, np.int64), *tracks]),
        "track_ends": np.cumsum([len(track) for track in tracks]).astype(np.int64),
    }
    if poses.evidence is not None:
        arrays |= {f"evidence_{name}": getattr(poses.evidence, name) for name in _EVIDENCE}
    return arrays


def _to_json(poses: Poses) -> dict[str, Any]:
    return {
        "files": list(poses.cam_from_world),
        "lens_of": poses.lens_of,
        "lenses": [[name, w, h, params.tolist()] for name, w, h, params in poses.lenses],
        "error_px": poses.error_px,
        "mapper": poses.mapper,
        "rival": poses.rival,
        "by_mat": list(poses.by_mat),
        "evidence": None if poses.evidence is None else list(poses.evidence.names),
    }


def _from_json(record: dict[str, Any], data: dict[str, NDArray[Any]]) -> Poses:
    files, names = record["files"], record["evidence"]
    ends = data["track_ends"]
    starts = np.concatenate([np.zeros(1, np.int64), ends])[: len(ends)]
    evidence = None
    if names is not None:
        evidence = Evidence(tuple(names), *(data[f"evidence_{name}"] for name in _EVIDENCE))
    return Poses(
        cam_from_world=dict(zip(files, data["poses"], strict=True)),
        lens_of={file: int(i) for file, i in record["lens_of"].items()},
        lenses=tuple((n, int(w), int(h), np.array(p, float)) for n, w, h, p in record["lenses"]),
        points=data["points"],
        colors=data["colors"],
        tracks={f: data["tracks"][a:b].copy() for f, a, b in zip(files, starts, ends, strict=True)},
        error_px=float(record["error_px"]),
        mapper=str(record["mapper"]),
        evidence=evidence,
        rival=record["rival"],
        by_mat=tuple(record["by_mat"]),
    )
