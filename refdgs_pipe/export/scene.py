"""What is around the asset: the light it stood in and the cameras, as a USD layer on top of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.about import About
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.usd import usd_data
from refdgs_pipe.export.validate import require, usd_faults

F32 = NDArray[np.float32]
ENVIRONMENT, SCENE = "environment.hdr", "scene.usda"
_APERTURE = 0.36  # 36 mm wide film, in USD's tenths of a metre


def write_environment(folder: Path, radiance: F32) -> None:
    """environment.hdr (Radiance RGBE): (H, 2H, 3) linear, laid out as `latlong_directions` says.

    Raises:
        ExportError: the radiance is not finite, or it cannot be written.
    """
    if not np.isfinite(radiance).all():
        raise ExportError("the environment holds values that are not finite: train again")
    done, content = cv2.imencode(".hdr", np.ascontiguousarray(radiance[..., ::-1], np.float32))
    if not done:
        raise ExportError(f"{ENVIRONMENT}: cannot encode {radiance.shape}")
    (folder / ENVIRONMENT).write_bytes(content.tobytes())


def write_scene(folder: Path, cameras: Sequence[Camera], frame: AssetFrame, about: About) -> None:
    """scene.usda: asset.usdc by reference, its environment (if written) and its cameras.

    Raises:
        ExportError: it did not pass its check.
    """
    from pxr import Kind, Sdf, Tf, Usd, UsdGeom, UsdLux

    path = folder / SCENE
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.assembly)
    root.GetPrim().SetCustomDataByKey("refdgs", usd_data(about))
    stage.DefinePrim("/scene/object").GetReferences().AddReference("./asset.usdc")
    if (folder / ENVIRONMENT).exists():
        light = UsdLux.DomeLight.Define(stage, "/scene/environment")
        light.CreateTextureFileAttr(Sdf.AssetPath(f"./{ENVIRONMENT}"))
        light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    UsdGeom.Scope.Define(stage, "/scene/cameras")
    taken: set[str] = set()
    for number, camera in enumerate(cameras):
        name = Tf.MakeValidIdentifier(camera.name)
        if name in taken:
            name = f"{name}_{number}"
        taken.add(name)
        _camera(UsdGeom.Camera.Define(stage, f"/scene/cameras/{name}"), camera, frame)
    stage.GetRootLayer().Save()
    require(path, usd_faults(path))


def _camera(prim: Any, camera: Camera, frame: AssetFrame) -> None:
    """Fill in a camera: USD's looks along -Z with +Y up, and measures its film, not pixels."""
    from pxr import Gf

    pose = np.eye(4)
    pose[:3, :3] = frame.turn @ camera.world_from_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = frame.points(camera.center[None])[0]
    prim.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))  # USD multiplies rows
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    width, focal = _APERTURE, _APERTURE * fx / camera.width
    height = camera.height / fy * focal
    prim.CreateFocalLengthAttr(float(focal))
    prim.CreateHorizontalApertureAttr(float(width))
    prim.CreateVerticalApertureAttr(float(height))
    prim.CreateHorizontalApertureOffsetAttr(float(width * (0.5 - cx / camera.width)))
    prim.CreateVerticalApertureOffsetAttr(float(height * (cy / camera.height - 0.5)))
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.001 * frame.metres_per_unit, 1e5))
    prim.GetPrim().SetCustomDataByKey("refdgs", usd_data({"split": camera.split}))
