"""What only the rasteriser of GPUs has, on the emulated grid; the rest is in test_rasterize."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from emulation import ORDERS, emulated
from ops.test_rasterize import MAPS, Made, camera, gradients, leaves, scene

from refdgs_pipe.ops import Pinhole, Surfels, rasterize


def crowd() -> Made:
    """Several chunks in a patch, and pixels that fill up within the first."""
    surfels, features = scene(400, seed=4)
    opacities = 0.3 + 0.69 * surfels.opacities
    return Surfels(surfels.means * 0.4, surfels.quats, surfels.scales, opacities), features


def both(make: Callable[[], Made], view: Pinhole, order: int = 0) -> None:
    surfels, features = make()
    wanted_maps = rasterize(surfels, features, view, extra="distortion", normals=True)
    wanted = gradients(surfels, features, view)
    with emulated(order):
        maps = rasterize(surfels, features, view, extra="distortion", normals=True)
        found = gradients(surfels, features, view)
    for name in MAPS:
        torch.testing.assert_close(
            getattr(maps, name), getattr(wanted_maps, name), rtol=1e-10, atol=1e-10
        )
    assert torch.equal(maps.statistics.radii, wanted_maps.statistics.radii)
    for name, value in wanted.items():
        scale = float(value.abs().max())
        torch.testing.assert_close(found[name], value, rtol=1e-8, atol=1e-10 * scale)


def test_a_crowd_of_surfels_is_drawn_as_on_the_cpu() -> None:
    """The definition has no memory for it."""
    both(crowd, camera())


@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_of_threads_changes_nothing(order: int) -> None:
    both(crowd, camera(), order)


@pytest.mark.parametrize("n", [150, 700, 2600])
@pytest.mark.parametrize("order", ORDERS[1:])
def test_lists_of_any_length_are_sorted(n: int, order: int) -> None:
    """By a warp, by a block in shared memory and where they lie; the same depth by index."""

    def make() -> Made:
        surfels, features = scene(n, seed=5)
        means = surfels.means * 0.05
        means[::3] = means[:1]
        opacities = 0.004 + 0.01 * surfels.opacities
        return Surfels(means, surfels.quats, surfels.scales, opacities), features

    both(make, camera(24, 20), order)


@pytest.mark.parametrize("channels", [1, 4, 9, 13, 17])
@pytest.mark.parametrize("extra", ["none", "depth", "distortion"])
def test_every_number_of_channels_and_kind_of_map(channels: int, extra: str) -> None:
    surfels, features = scene(60, channels, seed=channels)
    view = camera(20, 18)
    results = []
    for run in (False, True):
        s, f, v = leaves(surfels, features, view)
        if run:
            with emulated():
                maps = rasterize(s, f, v, extra=extra, normals=channels != 4)
                (maps.features.sin().sum() + maps.alpha.sum()).backward()
        else:
            maps = rasterize(s, f, v, extra=extra, normals=channels != 4)
            (maps.features.sin().sum() + maps.alpha.sum()).backward()
        pose = v.cam_from_world.grad
        results.append(
            [maps.features, s.means.grad, s.opacities.grad, f.grad, pose, maps.statistics.gradients]
        )
    for wanted, found in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-8, atol=1e-9)


def test_more_surfels_than_a_block_and_boxes_of_many_tiles() -> None:
    """Large boxes are walked by warps, small ones by threads; slots keep the surfels' order."""

    def make() -> Made:
        surfels, features = scene(700, seed=6)
        scales = surfels.scales * 0.2
        scales[::90] = 2.0
        return Surfels(surfels.means, surfels.quats, scales, surfels.opacities * 0.3), features

    both(make, camera(150, 120))


def test_a_lens_on_the_device_is_the_camera() -> None:
    """Also back to the surfels; the rest of what the camera says is then another's."""
    surfels, features = scene(60)
    view = camera(40, 30)
    moved = view.cam_from_world + 0.3 * torch.rand(4, 4, dtype=torch.float64)
    other = replace(view, cam_from_world=moved, fx=30.0, fy=31.0, cx=12.0, cy=9.0)
    held = replace(other, lens=torch.tensor(view.numbers(), dtype=torch.float64))
    found = []
    for seen in (view, held, other):
        s, f, _ = leaves(surfels, features, view)
        with emulated():
            maps = rasterize(s, f, seen, extra="distortion", normals=True)
            sum(getattr(maps, name).sin().sum() for name in MAPS).backward()
        found.append([maps.features.detach(), *(getattr(s, n).grad for n in vars(s)), f.grad])
    for wanted, same, wrong in zip(*found, strict=True):
        assert torch.equal(same, wanted) and not torch.equal(wrong, wanted)


def test_sums_of_absolute_values_can_be_left_out() -> None:
    surfels, features = scene(60)
    found = []
    for absolute in (True, False):
        s, f, v = leaves(surfels, features, camera())
        with emulated():
            maps = rasterize(s, f, v, extra="distortion", normals=True, absolute=absolute)
            maps.features.sin().sum().backward()
        found.append([maps.statistics.gradients[:, 0], s.means.grad, f.grad])
        assert bool(maps.statistics.gradients[:, 1].any()) == absolute
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_nothing_to_draw() -> None:
    for n, shift in ((0, 0.0), (1, -1e3), (3, 0.0)):
        surfels, features = scene(n)
        opacities = surfels.opacities * (0 if n == 3 else 1)
        s, f, v = leaves(
            Surfels(surfels.means + shift, surfels.quats, surfels.scales, opacities),
            features,
            camera(),
        )
        with emulated():
            maps = rasterize(s, f, v, extra="distortion", normals=True)
            (maps.alpha.sum() + maps.distortion.sum()).backward()
        assert float(maps.alpha.detach().abs().max()) == 0
        assert s.means.grad.shape == (n, 3) and not bool(s.means.grad.any())
        assert not bool(v.cam_from_world.grad.any())


def test_float_is_as_exact_as_the_cpu_and_the_same_every_time() -> None:
    surfels, features = scene(300, seed=8, dtype=torch.float32)
    view = camera(64, 48, torch.float32)
    exact = gradients(*scene(300, seed=8), camera(64, 48))
    ours = gradients(surfels, features, view)
    with emulated():
        first = gradients(surfels, features, view)
    with emulated(7):
        second = gradients(surfels, features, view)
    for name, value in exact.items():
        assert torch.equal(first[name], second[name]), name
        error, usual = (
            float((value - g[name].double()).norm() / value.norm()) for g in (first, ours)
        )
        assert error < 2 * usual + 1e-5, (name, error, usual)
