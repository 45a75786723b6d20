"""A finished field and its mesh against photos it has not seen, and against ground truth."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.scores import (
    VIEW_FIGURES,
    MaterialScore,
    Scores,
    SurfaceScore,
    ViewScore,
)
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.truth import scene_truth_files, view_truth_files
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import InputError
from refdgs_pipe.evaluation.alignment import laid, read_true_centers, world_from_truth
from refdgs_pipe.evaluation.materials import score_materials
from refdgs_pipe.evaluation.object_figures import TRAINING_VIEWS, Witness, over_white
from refdgs_pipe.evaluation.surface import score_surface
from refdgs_pipe.evaluation.truth import (
    ViewTruth,
    read_material_truth,
    read_true_mesh,
    read_true_parts,
    read_true_points,
    read_view_truth,
)
from refdgs_pipe.metrics import (
    depth_error,
    mask_iou,
    normal_error_deg,
    normal_error_over_white_deg,
    psnr,
    psnr_per_channel,
)
from refdgs_pipe.ops import ssim_map

F32 = NDArray[np.float32]
Track = Callable[[list[Camera]], Iterable[Camera]]
Distance = Callable[[F32, F32], float]
COMPARED_VIEWS, COMPARED_SIDE = 64, 320  # at most; pixels: for colours and reflections
_SOURCES = {
    "normal_mae_deg": "NAME_normal.png",
    "normal_mae_foreground_deg": "NAME_normal.png",
    "depth_mae": "NAME_depth.npz",
    "alpha_iou": "alpha channel or NAME_alpha.png",
}


@dataclass(frozen=True)
class Drawing:
    """How the result under test is drawn.

    Args:
        picture: the (H, W, 3) sRGB picture in [0, 1] over white that a camera takes.
        maps: what it sees of the surface.
        relit: the textured mesh in its own light: (H, W, 3) sRGB, not premultiplied, and (H, W)
            coverage; None where there is no light.
    """

    picture: Callable[[Camera], F32]
    maps: Callable[[Camera], SurfaceMap]
    relit: Callable[[Camera], tuple[F32, F32]] | None = None


@dataclass(frozen=True)
class Subject:
    """What is scored against what.

    Args:
        root: the folder that the sources of the views are relative to; truth lies in it.
        mesh: in the world frame of `model`.
        textured: the same with its textures, if they are scored too.
        ground: (3,) unit normal of the ground through the world's origin, if it is known.
        stands: whether the whole object has to reach it: where its masks were found as what stands
            on the ground.
        lowest: as `ObjectFigures` has it.
    """

    views: Views
    model: SparseModel
    mesh: TriangleMesh
    root: Path
    textured: TexturedMesh | None = None
    ground: NDArray[np.float64] | None = None
    stands: bool = False
    lowest: float | None = None

    @property
    def no_truth(self) -> str | None:
        """Why ground truth cannot be compared with, whatever there is; None if it can.

        Truth stands in the data set's own frame, which is the world only where its poses are kept.
        """
        posed = self.views.has_known_poses
        if posed and np.allclose(self.model.sfm_from_world, np.eye(4)):
            return None
        return "the capture came without poses: nothing ties its world to any ground truth"

    @property
    def no_true_maps(self) -> str | None:
        """Why maps of single photos cannot be compared with; None if they can."""
        if self.no_truth is None and not all(k.is_pinhole for k in self.model.lenses.values()):
            return "the photos' lens distortion is removed; ground truth of photos as taken is not"
        return self.no_truth


@dataclass(frozen=True)
class Protocol:
    """How views are compared.

    Args:
        longest: the longer side of what is compared is at most this, in pixels.
        lpips: the distance of two (H, W, 3) pictures in [0, 1], or None.
        track: wraps the cameras, to report progress.
    """

    longest: int
    lpips: Distance | None = None
    track: Track = field(default=lambda cameras: cameras)


def score(subject: Subject, drawing: Drawing, protocol: Protocol) -> Scores:
    """Figures of the held-out views (of all, if none was held out) and of the surface.

    Raises:
        CorruptError: a photo or a file of ground truth is damaged.
        InputError: ground truth does not fit its photo.
    """
    cameras = list(subject.model.cameras)
    held_out = [camera for camera in cameras if camera.split == "test"]
    witness = Witness(subject.mesh)
    views = [
        _score_view(subject, camera, drawing, protocol, witness)
        for camera in protocol.track(held_out or cameras)
    ]
    surface, why = _score_surface(subject, protocol.longest)
    notes = _notes(views, subject.no_true_maps, lpips=protocol.lpips is not None)
    if why is not None:
        notes["surface"] = why
    elif surface is not None:
        notes |= _surface_notes(surface)
    materials, why = _score_materials(subject, held_out or cameras)
    if why is not None:
        notes["materials"] = why
    split = "test" if held_out else "train"
    evidence = _evidence(subject, drawing, protocol, witness)
    return Scores(split, tuple(views), surface, materials=materials, notes=notes, evidence=evidence)


def gathered(subject: Subject, drawing: Drawing, protocol: Protocol) -> ObjectFigures:
    """The evidence alone, as `score` gathers it.

    Raises:
        CorruptError: a photo is damaged.
    """
    witness = Witness(subject.mesh)
    cameras = list(subject.model.cameras)
    for camera in [camera for camera in cameras if camera.split == "test"] or cameras:
        photo = _photo(subject, camera, protocol.longest)
        drawn = drawing.picture(photo.camera)
        asset = None if drawing.relit is None else _over(photo, drawn, drawing.relit)
        witness.look(photo, drawn, drawing.maps(photo.camera), asset)
    return _evidence(subject, drawing, protocol, witness)


def _evidence(
    subject: Subject, drawing: Drawing, protocol: Protocol, witness: Witness
) -> ObjectFigures:
    """What the witness says once it has seen some photos of the training too."""
    is_held_out = any(camera.split == "test" for camera in subject.model.cameras)
    if is_held_out:
        _look_at_training(subject, drawing, protocol, witness)
    cameras = subject.model.cameras
    some = np.unique(np.linspace(0, len(cameras) - 1, COMPARED_VIEWS).astype(int))
    return witness.evidence(
        subject.views,
        subject.model,
        subject.textured,
        held_out=is_held_out,
        photos=(_photo(subject, cameras[i], COMPARED_SIDE) for i in some),
        ground=subject.ground,
        stands=subject.stands,
        lowest=subject.lowest,
    )


def _surface_notes(surface: SurfaceScore) -> dict[str, str]:
    if surface.chamfer is None:
        return {"chamfer": "no gt_mesh.ply in the data set, only points"}
    if surface.paper_chamfer is None:
        return {"paper_chamfer": "the capture's own unit of length is not the truth's"}
    return {}


def _look_at_training(
    subject: Subject, drawing: Drawing, protocol: Protocol, witness: Witness
) -> None:
    """Show the witness some photos of the training, evenly chosen."""
    cameras = [camera for camera in subject.model.cameras if camera.split == "train"]
    for i in np.unique(np.linspace(0, len(cameras) - 1, TRAINING_VIEWS).astype(int)):
        if not cameras:
            return
        photo = _photo(subject, cameras[i], protocol.longest)
        maps = drawing.maps(photo.camera)
        witness.look(photo, drawing.picture(photo.camera), maps, trained=True)


def _photo(subject: Subject, camera: Camera, longest: int) -> Photo:
    scale = camera.fitted(longest).width / camera.width
    return load_photo(subject.views, subject.model, camera, scale=scale)


def _score_view(
    subject: Subject, camera: Camera, drawing: Drawing, protocol: Protocol, witness: Witness
) -> ViewScore:
    photo = _photo(subject, camera, protocol.longest)
    drawn, target = drawing.picture(photo.camera), over_white(photo)
    asset = None if drawing.relit is None else _over(photo, drawn, drawing.relit)
    object_psnr, asset_psnr = witness.look(photo, drawn, drawing.maps(photo.camera), asset)
    keep = photo.valid[..., None]
    image, target = np.where(keep, drawn, 0), np.where(keep, target, 0)
    similarity = ssim_map(_tensor(image), _tensor(target)).numpy()
    seen, wanted = image[photo.valid], target[photo.valid]
    return ViewScore(
        camera.name,
        psnr=psnr(seen, wanted),
        psnr_per_channel=psnr_per_channel(seen, wanted),
        ssim=float(similarity[photo.valid].mean()),
        lpips=None if protocol.lpips is None else protocol.lpips(image, target),
        relit_psnr=None if asset is None else psnr(asset[photo.valid], wanted),
        object_psnr=object_psnr,
        relit_object_psnr=asset_psnr,
        **_true_figures(subject, camera, drawing, protocol.longest),
    )


def _over(photo: Photo, image: F32, relit: Callable[[Camera], tuple[F32, F32]]) -> F32:
    """The relit asset over white where the photo is, else over the field's own picture."""
    drawn, alpha = relit(photo.camera)
    behind = image if photo.mask is None else np.float32(1)
    return np.asarray(drawn * alpha[..., None] + behind * (1 - alpha[..., None]), np.float32)


def _score_materials(
    subject: Subject, cameras: list[Camera]
) -> tuple[MaterialScore | None, str | None]:
    """The textures' score, or why there is none."""
    if subject.textured is None:
        return None, "the textures are not scored"
    if subject.no_true_maps:
        return None, subject.no_true_maps
    listed = scene_truth_files(subject.root).materials
    if listed is None:
        return None, "no materials.json in the data set"
    parts = read_true_parts(listed)
    pairs = []
    for camera in cameras:
        source = subject.root / subject.views[camera.name].source
        if not source.is_file():
            continue
        truth = read_material_truth(view_truth_files(source), list(parts))
        if truth is not None:
            height, width = truth.depth.shape
            pairs.append((camera.resized(width, height), truth))
    found = score_materials(subject.textured, pairs, list(parts.values()))
    return found, None if found else "no NAME_albedo.png beside the photos, or nothing to see"


def _true_figures(
    subject: Subject, camera: Camera, drawing: Drawing, longest: int
) -> dict[str, float]:
    """What ground truth says of a view, at the truth's own size; coverage alone may be reduced."""
    if subject.no_true_maps:
        return {}
    source = subject.root / subject.views[camera.name].source
    if not source.is_file():
        return {}
    truth = read_view_truth(view_truth_files(source))
    if truth.size is None:
        return {}
    width, height = truth.size
    if abs(width * camera.height - height * camera.width) > max(width, height):
        raise InputError(
            f"{source}: its ground truth is {width} x {height} pixels, the view "
            f"{camera.width} x {camera.height}. Give maps of the photo's shape"
        )
    sized = camera.resized(width, height)
    if truth.normal is None and truth.depth is None and truth.alpha is not None:
        sized = sized.fitted(longest)
        size = (sized.width, sized.height)
        alpha = cv2.resize(truth.alpha, size, interpolation=cv2.INTER_AREA)
        truth = replace(truth, alpha=np.asarray(alpha, np.float32))
    return compare_maps(drawing.maps(sized), truth)


def compare_maps(maps: SurfaceMap, truth: ViewTruth) -> dict[str, float]:
    """The figures of ViewScore that the truth allows, from maps of one size with it."""
    figures = {}
    if truth.normal is not None and truth.foreground is not None:
        over_white = normal_error_over_white_deg(maps.normal, maps.alpha, truth.normal)
        figures["normal_mae_deg"] = over_white
        if truth.foreground.any():
            there = truth.foreground
            figures["normal_mae_foreground_deg"] = normal_error_deg(
                maps.normal, truth.normal, there
            )
    if truth.depth is not None:
        both = (truth.depth > 0) & (maps.depth > 0) & (maps.alpha >= 0.5)
        if both.any():
            figures["depth_mae"] = depth_error(maps.depth, truth.depth, both)
    if truth.alpha is not None:
        figures["alpha_iou"] = mask_iou(maps.alpha >= 0.5, truth.alpha >= 0.5)
    return figures


def _score_surface(subject: Subject, longest: int) -> tuple[SurfaceScore | None, str | None]:
    """The surface's score, or why there is none."""
    files = scene_truth_files(subject.root)
    if subject.no_truth:
        if files.mesh is None or files.cameras is None:
            return None, subject.no_truth
        return _score_surface_by_cameras(subject, files.mesh, files.cameras, longest)
    if files.mesh is None and files.points is None:
        return None, "no gt_mesh.ply in the data set"
    found = score_surface(
        subject.mesh,
        _training_cameras(subject, longest),
        None if files.mesh is None else read_true_mesh(files.mesh),
        None if files.points is None else read_true_points(files.points),
        textured=subject.textured,
    )
    return found, None if found else "no training camera sees the mesh, or none the true surface"


def _score_surface_by_cameras(
    subject: Subject, mesh: Path, centers: Path, longest: int
) -> tuple[SurfaceScore | None, str | None]:
    """The surface's score where only the true cameras tell where the truth lies.

    Without masks, the mesh may hold what the object stands on.
    """
    model = subject.model
    world = world_from_truth(model.cameras, read_true_centers(centers))
    if world is None:
        return None, f"{centers.name} holds fewer than 3 of the photos, or all in one line"
    truth = laid(read_true_mesh(mesh), world)
    found = score_surface(
        subject.mesh,
        _training_cameras(subject, longest),
        truth,
        paper=False,
        among_others=subject.views.background == "photo",
        textured=subject.textured,
    )
    return found, None if found else "no training camera sees a mesh near the true surface"


def _training_cameras(subject: Subject, longest: int) -> list[Camera]:
    """Those of the train split, or all if there is none, no larger than `longest` pixels."""
    cameras = subject.model.training_cameras
    return [camera.fitted(longest) for camera in cameras]


def _notes(views: list[ViewScore], no_truth: str | None, *, lpips: bool) -> dict[str, str]:
    """Figure -> why no view, or not every view, has it."""
    notes = {}
    for figure in VIEW_FIGURES:
        known = sum(getattr(view, figure) is not None for view in views)
        if known == len(views):
            continue
        if figure == "lpips":
            notes[figure] = "no weights given (--lpips-weights)" if not lpips else "no view"
        elif figure == "object_psnr":
            notes[figure] = "the object is not in every view"
        elif figure in ("relit_psnr", "relit_object_psnr"):
            notes[figure] = "the field has no reflections, so there is no light to draw with"
        elif known:
            notes[figure] = f"{known} of {len(views)} views have a {_SOURCES[figure]}"
        else:
            notes[figure] = no_truth or f"no {_SOURCES[figure]} beside the photos"
    return notes


def _tensor(image: F32) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, np.float32))
