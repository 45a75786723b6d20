"""Gathering, compositing and normal agreement, against their definition and differences."""

import pytest
import torch
from ops.backends import At, Backend, by_definition
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import Pinhole

H, W = 9, 12
STEPS = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-5}


def camera(dtype: torch.dtype = torch.float64, size: tuple[int, int] = (H, W)) -> Pinhole:
    """A turned camera with rectangular pixels."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turn.Q * torch.sign(torch.linalg.det(turn.Q))
    return Pinhole(pose.to(dtype), 14.0, 15.0, 5.5, 4.8, size[1], size[0])


def maps(
    seed: int, dtype: torch.dtype = torch.float64, size: tuple[int, int] = (H, W)
) -> dict[str, Tensor]:
    """Splatted maps as leaves: plane by plane, as the rasteriser leaves them."""
    rng = torch.Generator().manual_seed(seed)

    def planes(channels: int) -> Tensor:
        made = torch.rand(channels, *size, generator=rng, dtype=torch.float64)
        return made.to(dtype).permute(1, 2, 0)

    alpha = planes(1)[..., 0] * 0.8 + 0.1
    alpha = torch.where(planes(1)[..., 0] < (0.2 if size == (H, W) else 0.02), 0.0, alpha)
    depth = (2 + planes(1)[..., 0]) * alpha
    made = {
        "features": planes(6),
        "alpha": alpha,
        "normal": planes(3) - 0.5,
        "near": planes(4) - 0.5,
        "depth": depth,
        "radiance": 1.5 * planes(3),
        "behind": planes(3) * 0.2,
    }
    return {name: value.requires_grad_() for name, value in made.items()}


def covered(alpha: Tensor) -> Tensor:
    return torch.nonzero(alpha.detach().reshape(-1) > 0.05).flatten()


def shade(m: dict[str, Tensor], view: Pinhole, near: bool, behind: bool) -> Tensor:
    """A picture through both operations, without a shader between."""
    pixels = covered(m["alpha"])
    diffuse, roughness, reflected, cosine, found = ops.shading_inputs(
        m["features"], m["alpha"], m["normal"], m["near"] if near else None, pixels, view
    )
    radiance = m["radiance"].reshape(-1, 3)[pixels] * cosine[:, None] + 0.3 * reflected.abs()
    if found is not None:
        radiance = radiance + found[:, :3] ** 2
    object_alpha = m["alpha"] * 0.9
    backdrop = torch.tensor([0.2, 0.5, 0.9]).to(m["alpha"])
    return ops.composite(
        diffuse * (0.5 + roughness[:, None]),
        radiance,
        pixels,
        object_alpha,
        m["alpha"],
        backdrop,
        m["behind"] if behind else None,
    )


def moved(at: At, made: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: at(value).requires_grad_() for name, value in made.items()}


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("behind", [False, True])
def test_pictures_and_gradients_equal_the_definition(
    near: bool, behind: bool, kernels: Backend
) -> None:
    def run(at: At) -> list[Tensor]:
        m = moved(at, maps(3))
        image = shade(m, camera(), near, behind)
        image.backward(torch.linspace(-1, 1, H * W * 3).double().reshape(H, W, 3).to(image))
        return [image.detach(), *(v.grad for v in m.values() if v.grad is not None)]

    kernels.equals_the_definition(run)


@pytest.mark.parametrize("edge", [float("inf"), 4.0])
def test_normal_agreement_equals_the_definition(edge: float, kernels: Backend) -> None:
    def run(at: At) -> list[Tensor]:
        m = moved(at, maps(4))
        loss = ops.normal_agreement(m["normal"], m["depth"], m["alpha"], camera(), edge=edge)
        (3 * loss).backward()
        return [loss.detach(), m["normal"].grad, m["depth"].grad, m["alpha"].grad]

    kernels.equals_the_definition(run)


def solid_maps(
    seed: int, dtype: torch.dtype = torch.float64, size: tuple[int, int] = (H, W)
) -> list[Tensor]:
    """What `normal_smoothness` is given: mostly solid, with small steps and some strong edges."""
    m = {name: value.detach() for name, value in maps(seed, dtype, size).items()}
    alpha = (0.8 + 2 * m["alpha"]).clamp(max=1)
    depth = (2 + 0.01 * m["features"][..., 4]) * alpha
    return [m["normal"].requires_grad_(), 0.1 * m["features"], depth, alpha, m["alpha"]]


@pytest.mark.parametrize("size", [(H, W), (21, 150), (2, 2)])
def test_normal_smoothness_equals_the_definition(size: tuple[int, int], kernels: Backend) -> None:
    made = solid_maps(4, size=size)
    assert (made[3] <= 0.9).any() or size == (2, 2)

    def run(at: At) -> list[Tensor]:
        normal, *rest = (at(t) for t in made)
        loss = ops.normal_smoothness(normal.requires_grad_(), *rest, shaded=0.3)
        (3 * loss).backward()
        return [loss.detach(), normal.grad]

    kernels.equals_the_definition(run)
    assert float(by_definition(run)[0]) > 0


def test_smoothness_and_its_gradient_equal_finite_differences_and_threads_do_not_matter() -> None:
    normal, *rest = solid_maps(5)

    def loss(normal: Tensor) -> Tensor:
        return ops.normal_smoothness(normal, *rest, shaded=0.05, weight=0.3)

    assert torch.autograd.gradcheck(loss, [normal], **STEPS)
    found = []
    for threads in (1, 2):
        normal, *rest = solid_maps(6, torch.float32, (40, 70))
        ops.normal_smoothness(normal, *rest, shaded=0.05, threads=threads).backward()
        found.append(normal.grad)
    assert torch.equal(*found)


def test_smoothness_spares_the_edges_of_colour_and_depth(backend: Backend) -> None:
    """The same step of the normal, where nothing else steps, the colour does, or the depth."""
    normal = torch.zeros(4, 6, 3).double()
    normal[:, :3, 0], normal[:, 3:, 1] = 1, 1
    features, alpha = torch.full((4, 6, 3), 0.5).double(), torch.ones(4, 6).double()
    depth = torch.full((4, 6), 2.0).double()
    other, behind = features.clone(), depth.clone()
    other[:, 3:] = 0.1
    behind[:, 3:] = 2.2
    plain, colored, apart = (
        float(ops.normal_smoothness(normal, f, z, alpha, alpha, shaded=0.05))
        for f, z in ((features, depth), (other, depth), (features, behind))
    )
    assert plain == pytest.approx(2 / 5)  # one of five steps to the right, |1| + |-1|
    assert colored < 1e-4 * plain
    assert apart < 1e-3 * plain


def test_gradients_equal_finite_differences(backend: Backend) -> None:
    m = maps(5)
    pixels, view = covered(m["alpha"]), camera()
    # below: away from the kinks of clipping, which are proved against the definition above
    dark = {name: (0.3 * m[name].detach()).requires_grad_() for name in ("features", "radiance")}
    backdrop = torch.tensor([0.2, 0.5, 0.9]).double()
    solid = (m["alpha"].detach() * 0.5 + 0.4).requires_grad_()

    def gather(features: Tensor, alpha: Tensor, normal: Tensor, near: Tensor) -> Tensor:
        parts = ops.shading_inputs(features, alpha, normal, near, pixels, view)
        return torch.cat([part.flatten() for part in parts if part is not None])

    assert torch.autograd.gradcheck(gather, [m["features"], solid, m["normal"], m["near"]], **STEPS)

    def compose(features: Tensor, radiance: Tensor, alpha: Tensor, behind: Tensor) -> Tensor:
        rows = [t.reshape(H * W, -1)[pixels][:, :3] for t in (features, radiance)]
        return ops.composite(*rows, pixels, 0.8 * alpha, alpha, backdrop, behind)

    assert torch.autograd.gradcheck(
        compose, [dark["features"], dark["radiance"], solid, m["behind"]], **STEPS
    )


def test_a_clipped_highlight_can_only_be_pulled_down(backend: Backend) -> None:
    bright = torch.full((2, 3), 3.0, dtype=torch.float64, requires_grad=True)
    none = torch.zeros(2, 3, dtype=torch.float64)
    alpha = torch.ones(1, 2, dtype=torch.float64)
    image = ops.composite(bright, none, torch.arange(2), alpha, alpha, torch.zeros(3).double())
    image.backward(torch.tensor([[[1.0], [-1.0]]]).double().expand(1, 2, 3))
    assert (bright.grad[0] > 0).all()
    assert (bright.grad[1] == 0).all()
    assert torch.allclose(image, torch.ones(1, 2, 3).double())


def test_float_is_as_good_as_float_gets_and_threads_do_not_matter() -> None:
    size = (21, 150)  # wide enough for whole vectors of any instruction set
    exact = maps(6, size=size)
    shade(exact, camera(size=size), True, True).sum().backward()
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        m = maps(6, torch.float32, size)
        shade(m, camera(torch.float32, size), True, True).sum().backward()
        view = camera(torch.float32, size)
        loss = ops.normal_agreement(m["normal"], m["depth"], m["alpha"], view)
        loss.backward()
        found.append((m["normal"].grad, m["depth"].grad))
        error = (m["features"].grad - exact["features"].grad).norm() / exact["features"].grad.norm()
        assert float(error) < 1e-5
    torch.set_num_threads(1)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_no_covered_pixel_is_an_empty_picture(backend: Backend) -> None:
    m = maps(7)
    none = torch.zeros(0, dtype=torch.int64)
    parts = ops.shading_inputs(m["features"], m["alpha"], m["normal"], None, none, camera())
    assert [len(part) for part in parts if part is not None] == [0, 0, 0, 0]
    zero = torch.zeros(H, W, dtype=torch.float64)
    image = ops.composite(
        parts[0], parts[2], none, zero, zero, torch.tensor([0.1, 0.2, 0.3]).double()
    )
    assert torch.allclose(image, torch.tensor([0.1, 0.2, 0.3]).double().expand(H, W, 3))


def test_wrong_sizes_are_refused() -> None:
    m = maps(8)
    pixels = covered(m["alpha"])
    with pytest.raises(ShapeError, match="normal"):
        ops.shading_inputs(m["features"], m["alpha"], m["normal"][1:], None, pixels, camera())
    with pytest.raises(ShapeError, match="4 channels"):
        ops.shading_inputs(m["normal"], m["alpha"], m["normal"], None, pixels, camera())
    with pytest.raises(ShapeError, match="one row for each pixel"):
        rows = torch.zeros(3, 3, dtype=torch.float64)
        ops.composite(rows, rows, pixels, m["alpha"], m["alpha"], torch.zeros(3).double())
    with pytest.raises(ShapeError, match="depth is"):
        ops.normal_agreement(m["normal"], m["depth"].float(), m["alpha"], camera())
    tiny = Pinhole(torch.eye(4).double(), 1.0, 1.0, 1.0, 1.0, 2, 2)
    with pytest.raises(ShapeError, match="four neighbours"):
        two = [m[name][:2, :2] for name in ("normal", "depth", "alpha")]
        ops.normal_agreement(*two, tiny)


def test_smoothness_needs_neighbours_on_two_sides_and_images_of_one_size() -> None:
    given = solid_maps(4)
    with pytest.raises(ShapeError, match="no pixel has neighbours on two sides"):
        ops.normal_smoothness(*(t[:1] for t in given), shaded=0.1)
    with pytest.raises(ShapeError, match="features is"):
        ops.normal_smoothness(given[0], given[1][1:], *given[2:], shaded=0.1)
