"""The rasteriser against its definition and against finite differences."""

from collections.abc import Callable
from dataclasses import fields
from functools import cache

import pytest
import torch
from ops.backends import At, Backend, by_definition
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import Maps, Pinhole, Surfels, rasterize, rotation_matrices

MAPS = ("features", "alpha", "normal", "depth", "median_depth", "distortion")
Made = tuple[Surfels, Tensor]


def camera(width: int = 37, height: int = 29, dtype: torch.dtype = torch.float64) -> Pinhole:
    pose = torch.eye(4, dtype=dtype)
    pose[:3, :3] = rotation_matrices(torch.tensor([[0.9, 0.2, -0.3, 0.1]], dtype=dtype))[0]
    pose[:3, 3] = torch.tensor([0.1, -0.2, 3.0], dtype=dtype)
    return Pinhole(pose, 41.0, 39.0, 18.3, 14.9, width, height, near=0.2)


def scene(
    n: int = 40, channels: int = 5, seed: int = 0, dtype: torch.dtype = torch.float64
) -> Made:
    g = torch.Generator().manual_seed(seed)
    means = (torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5) * 1.6
    quats = torch.randn(n, 4, generator=g, dtype=torch.float64)
    scales = 0.03 + 0.25 * torch.rand(n, 2, generator=g, dtype=torch.float64)
    opacities = 0.05 + 0.94 * torch.rand(n, generator=g, dtype=torch.float64)
    features = torch.randn(n, channels, generator=g, dtype=torch.float64)
    return Surfels(*(t.to(dtype) for t in (means, quats, scales, opacities))), features.to(dtype)


def hard_cases() -> Made:
    """Edge-on, tiny, huge, behind the camera, off the screen, almost and wholly transparent."""
    surfels, features = scene(60, seed=3)
    means, quats, scales, opacities = (
        t.clone() for t in (surfels.means, surfels.quats, surfels.scales, surfels.opacities)
    )
    scales[:8] = 1e-4
    scales[8:12] = 3.0
    scales[12:16, 0] = 1e-6
    means[16:20, 2] -= 8
    means[20:24, 0] += 30
    opacities[24:28] = 1e-3
    opacities[28:32] = 0.9999
    quats[32:40] = torch.tensor([1.0, 0, 1, 0]) + 1e-3 * quats[32:40]
    return Surfels(means, quats, scales, opacities), features


def many_thin() -> Made:
    """Long thin soft discs at every angle: two batches in a tile, contours that miss blocks."""
    surfels, features = scene(150, seed=11)
    scales = surfels.scales * torch.tensor([1.0, 0.05], dtype=torch.float64)
    means, opacities = surfels.means * 0.3, surfels.opacities * 0.1
    return Surfels(means, surfels.quats, scales, opacities), features


def loss_of(maps: Maps, seed: int = 1) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros((), dtype=torch.float64)
    for name in MAPS:
        value = getattr(maps, name)
        weight = torch.rand(value.shape, generator=g, dtype=torch.float64) - 0.3
        total = total + (value.double() * weight.to(value.device)).sum().cpu()
    return total


def leaves(surfels: Surfels, features: Tensor, view: Pinhole) -> tuple[Surfels, Tensor, Pinhole]:
    new = Surfels(*(getattr(surfels, f.name).clone().requires_grad_() for f in fields(surfels)))
    pose = view.cam_from_world.clone().requires_grad_()
    return new, features.clone().requires_grad_(), Pinhole(pose, *list(vars(view).values())[1:])


def gradients(surfels: Surfels, features: Tensor, view: Pinhole) -> dict[str, Tensor]:
    s, f, v = leaves(surfels, features, view)
    loss_of(rasterize(s, f, v, extra="distortion", normals=True)).backward()
    named = {name: getattr(s, name).grad for name in ("means", "quats", "scales", "opacities")}
    return {**named, "features": f.grad, "pose": v.cam_from_world.grad[:3]}


def maps_and_gradients(at: At, made: Made, view: Pinhole) -> list[Tensor]:
    """The pose stays where it is, as in training."""
    surfels = Surfels(*(at(getattr(made[0], f.name)) for f in fields(Surfels)))
    features = at(made[1])
    maps = rasterize(surfels, features, view, extra="distortion", normals=True)
    found = gradients(surfels, features, view)
    return [*(getattr(maps, name) for name in MAPS), *found.values()]


@cache
def defined(make: Callable[[], Made], size: tuple[int, int]) -> list[Tensor]:
    """By the definition, which takes a second: once for all backends."""
    return list(by_definition(lambda at: maps_and_gradients(at, make(), camera(*size))))


@pytest.mark.parametrize(
    ("make", "size"),
    [
        *[(make, (37, 29)) for make in (scene, hard_cases, many_thin)],
        *[(scene, size) for size in ((1, 1), (16, 16), (17, 31), (130, 9))],
    ],
)
def test_maps_and_gradients_equal_the_definition(
    make: Callable[[], Made], size: tuple[int, int], kernels: Backend
) -> None:
    found = maps_and_gradients(kernels.here, make(), camera(*size))
    kernels.agrees(found, defined(make, size), exact=1e-7)


def test_every_gradient_equals_finite_differences() -> None:
    """Few soft surfels, so that no pixel crosses a cut-off within the step."""
    surfels, features = scene(6, channels=2, seed=5)
    surfels = Surfels(surfels.means, surfels.quats, surfels.scales * 3, surfels.opacities * 0.5)
    view = camera(11, 9)
    exact = gradients(surfels, features, view)

    def value(**changed: Tensor) -> float:
        parts = {f.name: changed.get(f.name, getattr(surfels, f.name)) for f in fields(surfels)}
        pose = changed.get("pose", view.cam_from_world)
        v = Pinhole(pose, *list(vars(view).values())[1:])
        f = changed.get("features", features)
        return float(loss_of(rasterize(Surfels(**parts), f, v, extra="distortion", normals=True)))

    step = 1e-6
    wrong, total = 0, 0
    for name, gradient in exact.items():
        base = (
            view.cam_from_world
            if name == "pose"
            else features
            if name == "features"
            else getattr(surfels, name)
        )
        for index in range(gradient.numel()):
            up, down = base.clone(), base.clone()
            up.view(-1)[index] += step
            down.view(-1)[index] -= step
            numeric = (value(**{name: up}) - value(**{name: down})) / (2 * step)
            scale = float(gradient.abs().max())
            wrong += abs(numeric - float(gradient.reshape(-1)[index])) > 1e-5 * scale
            total += 1
    # a pixel whose alpha sits within the step of 1/255 jumps: a handful at most
    assert wrong <= 0.01 * total


def test_float_agrees_with_double_within_its_rounding() -> None:
    surfels, features = scene(300, seed=7)
    view = camera(64, 48)
    single = Surfels(*(getattr(surfels, f.name).float() for f in fields(surfels)))
    exact = rasterize(surfels, features, view, extra="distortion", normals=True)
    rough = rasterize(single, features.float(), view, extra="distortion", normals=True)
    for name in ("features", "alpha", "normal", "depth"):
        a, b = getattr(exact, name), getattr(rough, name).double()
        # single pixels flip at the 1/255 cut: the norm of the difference stays small
        assert float((a - b).norm() / a.norm()) < 1e-4, name


def test_float_gradients_agree_with_double() -> None:
    surfels, features = scene(300, seed=8)
    view = camera(64, 48)
    single = Surfels(*(getattr(surfels, f.name).float() for f in fields(surfels)))
    exact = gradients(surfels, features, view)
    rough = gradients(single, features.float(), view)
    for name, value in exact.items():
        error = float((value - rough[name].double()).norm() / value.norm())
        assert error < 3e-3, (name, error)


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    surfels, features = scene(20_000, seed=9, dtype=torch.float32)
    view = camera(200, 150, torch.float32)
    results = []
    for threads in (1, 2, 5):
        s, f, v = leaves(surfels, features, view)
        maps = rasterize(s, f, v, extra="depth", normals=True, threads=threads)
        (maps.features.sum() + maps.depth.sum()).backward()
        results.append((maps.features, s.means.grad, v.cam_from_world.grad))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_pixels_that_are_needed_do_not_notice_that_others_are_left_out(dtype: torch.dtype) -> None:
    """In float and double; a gradient from elsewhere counts for nothing."""
    surfels, features = scene(300, seed=12, dtype=dtype)
    view = camera(70, 45, dtype)
    needed = torch.rand(45, 70, generator=torch.Generator().manual_seed(5)) < 0.5
    needed[:, :20] = False
    found = []
    for given in (None, needed):
        s, f, v = leaves(surfels, features, view)
        maps = rasterize(s, f, v, extra="depth", normals=True, needed=given)
        pull = torch.rand(45, 70, generator=torch.Generator().manual_seed(6)).to(dtype)
        looked_at = pull * needed if given is None else pull
        ((maps.features.sum(-1) + maps.normal.sum(-1) + maps.depth) * looked_at).sum().backward()
        kept = [m.detach()[needed] for m in (maps.features, maps.normal, maps.depth, maps.alpha)]
        found.append([*kept, s.means.grad, s.quats.grad, s.scales.grad, s.opacities.grad, f.grad])
    for all_drawn, some_drawn in zip(*found, strict=True):
        assert float((all_drawn - some_drawn).abs().max()) <= 1e-6 * float(all_drawn.abs().max())
    with pytest.raises(ShapeError, match="give 45 rows of 70 torch"):
        rasterize(surfels, features, view, needed=needed.T)


def test_an_empty_set_draws_nothing_and_has_empty_gradients(backend: Backend) -> None:
    surfels, features = scene(0)
    s, f, v = leaves(surfels, features, camera())
    maps = rasterize(s, f, v, extra="depth", normals=True)
    maps.alpha.sum().backward()
    assert float(maps.alpha.detach().abs().max()) == 0 and s.means.grad.shape == (0, 3)


def test_non_finite_surfels_are_not_drawn() -> None:
    surfels, features = scene(20)
    broken = surfels.means.clone()
    broken[3] = float("nan")
    broken[4] = float("inf")
    maps = rasterize(
        Surfels(broken, surfels.quats, surfels.scales, surfels.opacities), features, camera()
    )
    assert bool(torch.isfinite(maps.features).all())
    assert float(maps.statistics.radii[3]) == 0


def test_screen_statistics_measure_the_pull_on_the_projected_centre() -> None:
    surfels, features = scene(1)
    view = camera()
    s, f, v = leaves(
        Surfels(surfels.means * 0, surfels.quats, surfels.scales, surfels.opacities), features, view
    )
    maps = rasterize(s, f, v)
    maps.features[:, : view.width // 2].sum().backward()
    plain, absolute = maps.statistics.gradients[0]
    assert float(plain) > 0 and float(absolute) >= float(plain)
    without = rasterize(s, f, v, absolute=False)
    without.features[:, : view.width // 2].sum().backward()
    assert float(without.statistics.gradients[0, 0]) == pytest.approx(float(plain))
    assert float(without.statistics.gradients[0, 1]) == 0


def test_sizes_that_disagree_are_named() -> None:
    surfels, features = scene(10)
    bad = Surfels(surfels.means, surfels.quats[:9], surfels.scales, surfels.opacities)
    with pytest.raises(ShapeError, match=r"quats is \(9, 4\), but means has N = 10"):
        rasterize(bad, features, camera())
    with pytest.raises(ShapeError, match="float32"):
        rasterize(surfels, features.float(), camera())
    with pytest.raises(ShapeError, match="at most 20"):
        rasterize(surfels, torch.zeros(10, 18, dtype=torch.float64), camera(), normals=True)


def test_a_device_without_kernels_and_an_image_without_pixels_are_named() -> None:
    surfels, features = scene(10)
    there = Surfels(*(getattr(surfels, f.name).to("meta") for f in fields(Surfels)))
    with pytest.raises(DeviceError, match="means is on meta, but this build computes on the CPU"):
        rasterize(there, features.to("meta"), camera())
    with pytest.raises(ShapeError, match="image of 0x9: give 1 to 32000 pixels a side"):
        rasterize(surfels, features, camera(0, 9))
