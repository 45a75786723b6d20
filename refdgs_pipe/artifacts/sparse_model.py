"""Where every photo was taken, and what of the object was seen from there."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.files.colmap import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    read_model,
    write_model,
)
from refdgs_pipe.names import fault_of

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Ball:
    """The ball that the object lives in, world units."""

    center: F64
    radius: float


@dataclass(frozen=True)
class Lost:
    """A view that found no place."""

    name: str
    reason: str


@dataclass(frozen=True)
class SparseModel:
    """Posed, distortion-free cameras and sparse points, all in the world frame of every later file.

    World frame: for known poses the input's own; for photos z is up, the origin is the object's
    centre on its support, and one unit is the object ball's radius (or a metre if known).

    Args:
        cameras: one per posed view, sorted by name, at the size of the view's image.
        lenses: view name -> lens of the photo as taken; `photos.load_photo` removes it.
        points: (P, 3) float64; point_colors: (P, 3) uint8 sRGB; P may be 0 (known poses).
        tracks: for each camera name the (n,) int indices of the points it sees.
        ball: the object ball.
        up: (3,) unit vector, world.
        sfm_from_world: (4, 4) similarity back to the frame of the structure from motion.
        metres_per_unit: None when nothing told the scale.
        lost: views without a pose and why.
        gains: view name -> factors of linear RGB that undo its own exposure and white balance;
            empty where all photos were taken alike.
    """

    cameras: tuple[Camera, ...]
    lenses: dict[str, Lens]
    points: F64
    point_colors: NDArray[np.uint8]
    tracks: dict[str, NDArray[np.int64]]
    ball: Ball
    up: F64
    sfm_from_world: F64
    metres_per_unit: float | None
    lost: tuple[Lost, ...]
    gains: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Of the posed views."""
        return [camera.name for camera in self.cameras]

    @property
    def training_cameras(self) -> list[Camera]:
        """Those that are not held out; all of them where every one is."""
        return [c for c in self.cameras if c.split == "train"] or list(self.cameras)

    def placed(self, poses: Mapping[str, F64], ball: Ball | None = None) -> Self:
        """The model with other poses: camera's name -> (4, 4) cam_from_world; the rest stays.

        Args:
            ball: another one, if it is known better.
        """
        cameras = (
            replace(camera, cam_from_world=poses.get(camera.name, camera.cam_from_world))
            for camera in self.cameras
        )
        return replace(self, cameras=tuple(cameras), ball=self.ball if ball is None else ball)

    def save(self, folder: Path) -> None:
        """Write a COLMAP model of the undistorted cameras to sparse/0, the rest to model.json."""
        write_model(folder / "sparse" / "0", _to_colmap(self))
        kinds = {_lens_key(lens): lens for lens in self.lenses.values()}
        order = {key: i for i, key in enumerate(kinds)}
        record = {
            "ball": {"center": self.ball.center.tolist(), "radius": self.ball.radius},
            "up": self.up.tolist(),
            "sfm_from_world": self.sfm_from_world.tolist(),
            "metres_per_unit": self.metres_per_unit,
            "lenses": [
                {"K": k.K.tolist(), "distortion": k.distortion.tolist()} for k in kinds.values()
            ],
            "lens_of": {name: order[_lens_key(lens)] for name, lens in self.lenses.items()},
            "test": [camera.name for camera in self.cameras if camera.split == "test"],
            "lost": [asdict(view) for view in self.lost],
            "gains": self.gains,
        }
        (folder / "model.json").write_text(json.dumps(record, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged.
        """
        colmap = read_model(folder / "sparse" / "0")
        try:
            record = json.loads((folder / "model.json").read_text(encoding="utf-8"))
            kinds = [
                Lens(np.array(k["K"], float), np.array(k["distortion"], float))
                for k in record["lenses"]
            ]
            _view_names(colmap)
            ball = Ball(np.array(record["ball"]["center"], float), record["ball"]["radius"])
            return cls(
                cameras=_from_colmap(colmap, set(record["test"])),
                lenses={name: kinds[i] for name, i in record["lens_of"].items()},
                points=colmap.xyz,
                point_colors=colmap.rgb,
                tracks={_view_name(i.name): i.point_ids for i in colmap.images.values()},
                ball=ball,
                up=np.array(record["up"], float),
                sfm_from_world=np.array(record["sfm_from_world"], float),
                metres_per_unit=record["metres_per_unit"],
                lost=tuple(Lost(**view) for view in record["lost"]),
                gains=_gains(record.get("gains", {})),
            )
        except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
            raise CorruptError(f"{folder / 'model.json'}: {error}") from None


def _gains(record: dict[str, list[float]]) -> dict[str, tuple[float, float, float]]:
    """Factors as they were written.

    Raises:
        ValueError: they are no three positive numbers.
    """
    found = {}
    for name, (red, green, blue) in record.items():
        found[name] = (float(red), float(green), float(blue))
        if not all(0 < factor < np.inf for factor in found[name]):
            raise ValueError(f"gains of {name}: three positive numbers are expected")
    return found


def _view_name(image_name: str) -> str:
    return image_name.removesuffix(".png")


def _lens_key(lens: Lens) -> tuple[float, ...]:
    return (*lens.K.ravel().tolist(), *lens.distortion.tolist())


def _to_colmap(model: SparseModel) -> ColmapModel:
    """The keypoints are where the points project to; the points keep their order as their ids."""
    from scipy.spatial.transform import Rotation

    cameras: dict[tuple[Any, ...], int] = {}
    images = {}
    for number, camera in enumerate(model.cameras, start=1):
        K, pose = camera.K, camera.cam_from_world
        params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        camera_id = cameras.setdefault((camera.width, camera.height, *params), len(cameras) + 1)
        ids = model.tracks.get(camera.name, np.zeros(0, np.int64))
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        keypoints, _ = camera.project(model.points[ids])
        file = f"{camera.name}.png"
        images[number] = ColmapImage(quat, pose[:3, 3], camera_id, file, keypoints, ids)
    return ColmapModel(
        {i: ColmapCamera("PINHOLE", k[0], k[1], np.array(k[2:])) for k, i in cameras.items()},
        images,
        np.arange(len(model.points), dtype=np.int64),
        model.points,
        model.point_colors,
        np.full(len(model.points), -1.0),
    )


def _view_names(colmap: ColmapModel) -> None:
    """Refuse names of views that would lead elsewhere as file names.

    Raises:
        ValueError: one does.
    """
    for image in colmap.images.values():
        if (fault := fault_of(image.name)) or "/" in image.name:
            raise ValueError(f"{image.name}: {fault or 'a name of a view has no folder'}")


def _from_colmap(colmap: ColmapModel, test: set[str]) -> tuple[Camera, ...]:
    from scipy.spatial.transform import Rotation

    cameras = []
    for image in colmap.images.values():
        lens = colmap.cameras[image.camera_id]
        fx, fy, cx, cy = lens.params
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(image.quat, scalar_first=True).as_matrix()
        pose[:3, 3] = image.translation
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        name = _view_name(image.name)
        split = "test" if name in test else "train"
        cameras.append(Camera(name, lens.width, lens.height, K, pose, split))
    return tuple(sorted(cameras, key=lambda camera: camera.name))
