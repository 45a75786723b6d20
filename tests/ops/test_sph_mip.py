"""Sph-Mip lookups against their definition, closed forms and finite differences."""

import math
from collections.abc import Callable

import pytest
import torch
from ops.backends import Backend
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import sph_mip

SIZES = [(2, 2), (2, 8), (16, 4), (8, 16), (64, 128)]


def query(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Directions of any length, some at the poles and the seam, and roughness past 0..1."""
    g = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=g, dtype=torch.float64)
    special = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [1, -1e-9, 0], [-1, 0, 0], [1e-5, -2e-5, 1]]
    special += [[1e-2, 0, -1], [0, 0.03, 1], [-1, 1e-7, 0.2]]
    n = min(count, len(special))
    directions[:n] = torch.tensor(special[:n], dtype=torch.float64)
    return directions, 1.3 * torch.rand(count, generator=g, dtype=torch.float64) - 0.15


def random_map(height: int, width: int, seed: int = 5) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(height, width, 4, generator=g, dtype=torch.float64)


def pulled(
    lookup: Callable[..., Tensor],
    base: Tensor,
    directions: Tensor,
    roughness: Tensor,
    **options: float,
) -> list[Tensor]:
    """The features, and the gradients of a random combination of them."""
    leaves = [t.clone().requires_grad_() for t in (base, directions, roughness)]
    features = lookup(*leaves, **options)
    g = torch.Generator().manual_seed(9)
    pull = torch.randn(features.shape, generator=g, dtype=torch.float64).to(features)
    (features * pull).sum().backward()
    return [features.detach(), *(leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("count", [1, 37, 300])
def test_lookups_and_gradients_equal_the_definition(
    size: tuple[int, int], count: int, kernels: Backend
) -> None:
    given = (random_map(*size), *query(count))
    # a GPU adds the map's gradient in whole numbers, each rounded to 2^-42 of the greatest
    kernels.equals_the_definition(lambda at: pulled(sph_mip, *(at(t) for t in given)))


def test_a_least_level_keeps_finer_ones_out(kernels: Backend) -> None:
    given = (random_map(16, 32), *query(50))
    kernels.equals_the_definition(
        lambda at: pulled(sph_mip, *(at(t) for t in given), min_level=1.25)
    )


def test_gradients_equal_finite_differences(backend: Backend) -> None:
    """Away from texel borders, level borders and the poles, where the function has kinks."""
    base = random_map(4, 8)
    g = torch.Generator().manual_seed(2)
    v = (torch.randint(0, 3, (6,), generator=g) + 0.6 + 0.3 * torch.rand(6, generator=g)) / 4
    u = (torch.randint(0, 8, (6,), generator=g) + 0.6 + 0.3 * torch.rand(6, generator=g)) / 8
    theta, phi = (v * math.pi).double(), (u * 2 * math.pi).double()
    directions = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    roughness = torch.full((6,), 0.3, dtype=torch.float64)
    leaves = [t.requires_grad_() for t in (base, directions, roughness)]
    assert torch.autograd.gradcheck(lambda *t: sph_mip(*t, threads=1), leaves, eps=1e-6)


def test_texel_centres_return_texels(backend: Backend) -> None:
    base = random_map(8, 16)
    row, column = torch.meshgrid(torch.arange(8), torch.arange(16), indexing="ij")
    theta = (row.flatten().double() + 0.5) / 8 * math.pi
    phi = (column.flatten().double() + 0.5) / 16 * 2 * math.pi
    directions = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    features = sph_mip(base, directions, torch.zeros(128, dtype=torch.float64))
    torch.testing.assert_close(features, base.reshape(-1, 4), rtol=1e-9, atol=1e-9)


def test_the_pole_is_the_same_from_opposite_sides(backend: Backend) -> None:
    """Crossing it along a meridian meets no jump, at any level."""
    base = random_map(16, 32)
    for phi in (0.1, 2.0, 4.4):
        for z in (1.0, -1.0):
            side = torch.tensor([[math.cos(phi), math.sin(phi), 0.0]], dtype=torch.float64)
            up = torch.tensor([[0.0, 0.0, z]], dtype=torch.float64)
            directions = torch.cat([up + 1e-9 * side, up - 1e-9 * side])
            for rough in (0.0, 0.4, 0.9):
                a, b = sph_mip(base, directions, torch.full((2,), rough, dtype=torch.float64))
                torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


def test_a_rough_surface_sees_the_average_of_the_coarsest_level(backend: Backend) -> None:
    base = torch.zeros(8, 8, 4, dtype=torch.float64)
    base[:4, :4] = 1
    centre = torch.tensor([[0.0, 1.0, 1.0]], dtype=torch.float64)  # of one of the last 2 x 2 texels
    features = sph_mip(base, centre, torch.ones(1, dtype=torch.float64))
    torch.testing.assert_close(features, torch.ones(1, 4, dtype=torch.float64))


def test_gradients_are_finite_everywhere_in_float(backend: Backend) -> None:
    directions, roughness = (t.float() for t in query(64))
    directions[40] = 0
    for value in pulled(sph_mip, random_map(32, 64).float(), directions, roughness):
        assert bool(torch.isfinite(value).all())


def test_non_finite_queries_do_not_read_outside_the_map() -> None:
    directions, roughness = (t.float() for t in query(40))
    directions[3] = float("nan")
    directions[4] = float("inf")
    roughness[5] = float("nan")
    features = pulled(sph_mip, random_map(32, 64).float(), directions, roughness)[0]
    assert bool(torch.isfinite(features[6:]).all())


def test_float_agrees_with_double_within_its_rounding() -> None:
    """Coordinates have 24 bits: 1e-7 of a 64 texels wide map times its slope between texels."""
    base, (directions, roughness) = random_map(32, 64), query(3000)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    exact = pulled(sph_mip, base, directions, roughness)
    rough = pulled(sph_mip, base.float(), directions.float(), roughness.float())
    assert float((exact[0] - rough[0].double()).abs().max()) < 2e-4
    keep = torch.linalg.norm(directions[:, :2], dim=-1) > 0.01  # azimuth amplifies at the poles
    for a, b in zip(exact[1:], rough[1:], strict=True):
        if len(a) == len(keep):
            a, b = a[keep], b[keep]
        error = (a - b.double()).flatten()
        # a direction that rounds across a texel's border takes the next texel's slope
        assert float(error.norm() / a.norm()) < 5e-3


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    base, (directions, roughness) = random_map(64, 128).float(), query(30_000)
    inputs = (base, directions.float(), roughness.float())
    results = [pulled(sph_mip, *inputs, threads=threads) for threads in (1, 2, 3, 11)]
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_any_strides_are_read_as_they_are(backend: Backend) -> None:
    base, (directions, roughness) = random_map(8, 8), query(33)
    wide = torch.zeros(3, 33, 2, dtype=torch.float64)
    wide[..., 0] = directions.T
    strided = wide[..., 0].T
    assert torch.equal(sph_mip(base, directions, roughness), sph_mip(base, strided, roughness))


def test_no_directions_give_no_features_and_zero_gradient(backend: Backend) -> None:
    directions, roughness = torch.zeros(0, 3), torch.zeros(0)
    features, v_base, v_directions, _ = pulled(
        sph_mip, random_map(8, 16).float(), directions, roughness
    )
    assert features.shape == (0, 4) and v_directions.shape == (0, 3)
    assert float(v_base.abs().max()) == 0


def test_wrong_sizes_are_named() -> None:
    base, (directions, roughness) = random_map(8, 16), query(5)
    with pytest.raises(ShapeError, match=r"base is \(8, 15, 4\)"):
        sph_mip(base[:, :15], directions, roughness)
    with pytest.raises(ShapeError, match=r"directions is \(5, 2\)"):
        sph_mip(base, directions[:, :2], roughness)
    with pytest.raises(ShapeError, match=r"roughness is \(4,\) but directions has P = 5"):
        sph_mip(base, directions, roughness[:4])
    with pytest.raises(ShapeError, match="levels 0 to 2"):
        sph_mip(base, directions, roughness, min_level=3)
    with pytest.raises(ShapeError, match=r"roughness is torch.float32"):
        sph_mip(base, directions, roughness.float())
    with pytest.raises(DeviceError, match="meta"):
        sph_mip(base, directions.to("meta"), roughness)
