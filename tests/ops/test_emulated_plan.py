"""Lists whose room is planned, on the emulated grid: the same numbers, or a misfit that says so."""

from collections.abc import Callable
from dataclasses import fields

import pytest
import torch
from emulation import emulated
from ops import test_shade as shades
from ops.test_emulated_rasterize import crowd
from ops.test_rasterize import MAPS, camera, leaves, many_thin, scene
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import Pinhole, Plan, Readback, Surfels, covered_pixels, plan, rasterize

Made = tuple[Surfels, Tensor]


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room that small lists can outgrow."""
    monkeypatch.setattr(plan, "LEAST", 1)
    monkeypatch.setattr(plan, "LADDER", 2.0)


def drawn(made: Made, view: Pinhole, room: Plan | None) -> dict[str, Tensor]:
    """Maps and gradients."""
    s, f, v = leaves(*made, view)
    maps = rasterize(s, f, v, extra="distortion", normals=True, plan=room)
    out = {name: getattr(maps, name) for name in MAPS}
    sum(m.sin().sum() for m in out.values()).backward()
    parts = {f.name: getattr(s, f.name).grad for f in fields(s)} | {"pose": v.cam_from_world.grad}
    return {k: t.detach() for k, t in {**out, **parts, "features grad": f.grad}.items()}


@pytest.mark.parametrize("make", [scene, many_thin, crowd, lambda: scene(0)])
@pytest.mark.parametrize("spare", [1.0, 1.5, 40.0])
def test_planned_drawing_is_drawing(
    make: Callable[[], Made], spare: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "MARGIN", spare)
    room = Plan("cpu")
    with emulated():
        wanted = drawn(make(), camera(), None)
        for _ in range(2):
            room.begin()
            found = drawn(make(), camera(), room)
            for name, value in wanted.items():
                assert torch.equal(found[name], value), name
            assert float(room.misfit) == 0 and room.learn(room.asked(), room.needed)
    if spare == 40.0 and len(make()[1]):
        assert room.asked()[0][2] > 20 * int(room.last())


def test_entries_without_room_are_a_misfit_that_the_next_step_has_room_for() -> None:
    small, large = scene(30), scene(400)
    room = Plan("cpu")
    with emulated():
        room.begin()
        drawn(small, camera(20, 18), room)
        key = room.asked()[0][0]
        room._most[key] /= 50
        room.begin()
        drawn(large, camera(20, 18), room)
        assert float(room.misfit) == 1
        assert not room.learn(room.asked(), room.needed.clone())
        room.begin()
        found = drawn(large, camera(20, 18), room)
        assert float(room.misfit) == 0 and room.learn(room.asked(), room.needed)
        wanted = drawn(large, camera(20, 18), None)
    for name, value in wanted.items():
        assert torch.equal(found[name], value), name


def test_a_list_longer_than_possible_is_an_error() -> None:
    room = Plan("cpu")
    for _ in range(2):
        room.begin()
        if _:
            with pytest.raises(ShapeError, match="at most 100"):
                room.room("x", items=1, most=100, count=lambda: 0)
        else:
            assert room.room("x", items=1, most=100, count=lambda: 90) == 100
            room.needed[0] = 101
            assert not room.learn(room.asked(), room.needed)


@pytest.mark.parametrize("size", [(1, 1), (3, 70), (40, 37), (16, 16)])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_covered_pixels_are_listed_and_padded(size: tuple[int, int], share: float) -> None:
    g = torch.Generator().manual_seed(3)
    alpha = (torch.rand(*size, 2, generator=g).double() < share)[..., 1] * 0.5
    wanted = covered_pixels(alpha, 0.05)
    room = Plan("cpu")
    room.begin()
    with emulated():
        found = covered_pixels(alpha, 0.05, room)
    count = len(wanted)
    assert torch.equal(found[:count], wanted) and bool((found[count:] == -1).all())
    assert int(room.last()) == count and float(room.misfit) == 0
    if count > 4:
        room._most[room.asked()[0][0]] = 2 / alpha.numel()
        room.begin()
        with emulated():
            found = covered_pixels(alpha, 0.05, room)
        assert torch.equal(found, wanted[: len(found)]) and len(found) < count
        assert float(room.misfit) == 1 and not room.learn(room.asked(), room.needed)


@pytest.mark.parametrize("near", [False, True])
def test_what_is_made_of_no_pixel_counts_for_nothing(near: bool) -> None:
    """Through the gathering, Sph-Mip, the network and the composite, and back."""
    g = torch.Generator().manual_seed(7)
    inputs = 10 if near else 6
    shapes = {"map": (16, 32, 4), "w0": (64, inputs), "b0": (64,), "w1": (3, 64), "b1": (3,)}
    given = {k: torch.randn(*s, generator=g).double() for k, s in shapes.items()}
    backdrop = torch.rand(3, generator=g).double()

    def run(room: Plan | None) -> dict[str, Tensor]:
        if room is not None:
            room.begin()
        m = shades.maps(3)
        p = {k: v.clone().requires_grad_() for k, v in given.items()}
        pixels = covered_pixels(m["alpha"], 0.4, room)
        limit = None if room is None else room.last()
        diffuse, roughness, reflected, cosine, close = ops.shading_inputs(
            m["features"], m["alpha"], m["normal"], m["near"] if near else None, pixels,
            shades.camera(),
        )  # fmt: skip
        far = ops.sph_mip(p["map"], reflected, roughness, limit=limit)
        parts = [far, roughness[:, None], cosine[:, None], *([close] if near else [])]
        x = torch.cat(parts, -1)
        radiance = ops.mlp(x, [p["w0"], p["w1"]], [p["b0"], p["b1"]], exp_cap=2.0, limit=limit)
        image = ops.composite(diffuse, radiance, pixels, m["alpha"], m["alpha"], backdrop)
        image.backward(torch.linspace(-1, 1, image.numel()).double().reshape(image.shape))
        leaves_of = {**p, **m}
        grads = {k: v.grad for k, v in leaves_of.items() if v.grad is not None}
        return {"image": image.detach(), **grads}

    room = Plan("cpu")
    with emulated():
        wanted = run(None)
        for _ in range(2):
            found = run(room)
            assert room.asked()[0][2] > int(room.last()) > 32
            for name, value in wanted.items():
                torch.testing.assert_close(found[name], value, rtol=1e-12, atol=1e-12)


def test_numbers_are_read_some_steps_later_in_order() -> None:
    later: Readback[int] = Readback("cpu", lag=2)
    for step in range(4):
        later.send(step, torch.tensor([step]))
    assert [note for note, _ in later.arrived()] == [0, 1]
    later.send(4, torch.tensor([4]))
    assert [int(n[0]) for _, n in later.arrived(all_of_them=True)] == [2, 3, 4]
    assert later.arrived() == []
