"""The surfels for splat viewers: a PLY in the 2DGS convention, and a USD particle field."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surfel_field import SurfelSet
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import ShapeError
from refdgs_pipe.export.about import About
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.usd import usd_data
from refdgs_pipe.files.ply import write_ply

F32 = NDArray[np.float32]

_SH_DC = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))


def in_asset_frame(surfels: SurfelSet, frame: AssetFrame) -> SurfelSet:
    """The surfels turned to +Y up, in metres.

    Raises:
        ShapeError: arrays of different lengths, or no diffuse colour.
    """
    from scipy.spatial.transform import Rotation

    if "diffuse" not in surfels.values:
        raise ShapeError("surfels carry no diffuse colour: give the field's geometry")
    arrays = (surfels.means, surfels.quats, surfels.scales, surfels.opacities)
    counts = {len(values) for values in (*arrays, surfels.values["diffuse"])}
    if len(counts) != 1:
        raise ShapeError(f"surfel arrays have {sorted(counts)} rows: give one length")
    quats = surfels.quats
    if len(quats):
        turned = Rotation.from_matrix(frame.turn) * Rotation.from_quat(quats, scalar_first=True)
        quats = turned.as_quat(scalar_first=True).astype(np.float32)
    return SurfelSet(
        means=frame.points(surfels.means).astype(np.float32),
        quats=quats,
        scales=np.asarray(surfels.scales * frame.metres_per_unit, np.float32),
        opacities=surfels.opacities,
        values=surfels.values,
    )


def write_splats(path: Path, surfels: SurfelSet) -> None:
    """Write surfels, with their diffuse colour, as a PLY that splat viewers read."""
    dc = (srgb_from_linear(surfels.values["diffuse"]) - 0.5) / _SH_DC
    opacity = np.clip(surfels.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    columns = {
        **_named(("x", "y", "z"), surfels.means),
        **_named(("nx", "ny", "nz"), _normals(surfels.quats)),
        **_named(("f_dc_0", "f_dc_1", "f_dc_2"), dc),
        "opacity": np.log(opacity / (1 - opacity)).astype(np.float32),
        **_named(("scale_0", "scale_1"), np.log(np.maximum(surfels.scales, 1e-12))),
        **_named(("rot_0", "rot_1", "rot_2", "rot_3"), surfels.quats),
    }
    write_ply(path, columns, comments=["SplatRenderMode: 2dgs"])


def write_particle_field(path: Path, surfels: SurfelSet, about: About) -> bool:
    """Write surfels as OpenUSD's Gaussian surflets. False, and no file, if this USD has none.

    As in the PLY, and as readers take it, a colour is 1/2 + coefficient * Y00, sRGB-encoded.
    """
    from pxr import Kind, Usd, UsdGeom, UsdVol, Vt

    if not hasattr(UsdVol, "ParticleFieldKernelGaussianSurfletAPI"):
        return False
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/surfels")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    root.GetPrim().SetCustomDataByKey("refdgs", usd_data(about))
    field = UsdVol.ParticleField.Define(stage, "/surfels/field")
    prim = field.GetPrim()
    UsdVol.ParticleFieldKernelGaussianSurfletAPI.Apply(prim)
    count = len(surfels.means)
    flat = np.concatenate([surfels.scales, np.zeros((count, 1), np.float32)], 1)
    quats = np.roll(surfels.quats, -1, axis=1)  # USD keeps the real part last
    UsdVol.ParticleFieldPositionAttributeAPI.Apply(prim).CreatePositionsAttr(
        Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(surfels.means))
    )
    UsdVol.ParticleFieldOrientationAttributeAPI.Apply(prim).CreateOrientationsAttr(
        Vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats, np.float32))
    )
    UsdVol.ParticleFieldScaleAttributeAPI.Apply(prim).CreateScalesAttr(
        Vt.Vec3fArray.FromNumpy(flat)
    )
    UsdVol.ParticleFieldOpacityAttributeAPI.Apply(prim).CreateOpacitiesAttr(
        Vt.FloatArray.FromNumpy(np.ascontiguousarray(surfels.opacities))
    )
    radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI.Apply(prim)
    radiance.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    dc = np.asarray((srgb_from_linear(surfels.values["diffuse"]) - 0.5) / _SH_DC, np.float32)
    radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(dc))
    if count:
        reach = surfels.scales.max(1, keepdims=True) * 3
        corners = np.stack([(surfels.means - reach).min(0), (surfels.means + reach).max(0)])
        UsdGeom.Boundable(prim).CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    stage.GetRootLayer().Save()
    return True


def _named(names: tuple[str, ...], values: F32) -> dict[str, F32]:
    return {name: values[:, i].astype(np.float32) for i, name in enumerate(names)}


def _normals(quats: F32) -> F32:
    """(N, 3) third column of the rotations."""
    w, x, y, z = quats.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
