"""Light that moves, in what is drawn: against plain geometry and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from refdgs_pipe.artifacts.lighting import BANDS, Flash, Lighting, Ring, Turntable, turned
from refdgs_pipe.ops import Maps, Pinhole, ScreenStatistics
from refdgs_pipe.training.moving_light import MovingLight, in_camera, moving
from refdgs_pipe.training.reflection import Shader, specular

SIDE = 8
AXIS = np.array([0.0, 0.6, 0.8])


def table(shade: float = 0.0) -> Lighting:
    rng = np.random.default_rng(1)
    rings = (Ring(1.0, 2.0), Ring(2.0, 1.5, 0.2))
    coefficients = shade * rng.normal(size=(BANDS, 3))
    return Lighting("turntable", "", turntable=Turntable(np.zeros(3), AXIS, rings, coefficients))


def flash(lamp: tuple[float, float, float] = (0.1, -0.2, 0.0), room: float = 0.2) -> Lighting:
    return Lighting("flash", "", flash=Flash(np.array(lamp), 3.0, room))


def camera(center: np.ndarray) -> Pinhole:
    rotation = turned(np.array([0.0, 0.0, 1.0]), 0.3) @ turned(np.array([1.0, 0.0, 0.0]), 0.4)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return Pinhole(torch.from_numpy(pose).float(), SIDE, SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)


def maps(normal: Tensor, depth: float = 3.0) -> Maps:
    """The same normal (3,) in every pixel, seen to 80 %."""
    alpha = torch.full((SIDE, SIDE), 0.8)
    none = ScreenStatistics(torch.zeros(0), torch.zeros(0, 2))
    normals = (0.8 * normal).expand(SIDE, SIDE, 3)
    return Maps(torch.zeros(SIDE, SIDE, 4), alpha, normals, alpha * depth, None, None, none)


def test_light_that_stands_still_needs_nothing() -> None:
    assert moving(Lighting("world")) is None
    assert moving(None) is None


def test_the_room_is_turned_as_the_artifact_says() -> None:
    light, lighting = MovingLight(table()), table()
    first, _ = lighting.turntable.sides if lighting.turntable else (AXIS, AXIS)
    for center in (2 * first + AXIS, -1.5 * first + 2 * AXIS):
        found = light.light_from_world(camera(center))
        assert found is not None
        assert found.detach().numpy() == pytest.approx(lighting.light_from_world(center), abs=1e-5)


def test_a_recorded_step_reads_the_camera_from_its_lens() -> None:
    plain = camera(np.array([1.0, -2.0, 1.0]))
    lensed = replace(plain, cam_from_world=torch.eye(4), lens=torch.tensor(plain.numbers()))
    seen = maps(torch.tensor([0.0, 0.6, 0.8]))
    pixels = torch.arange(SIDE * SIDE)
    for lighting in (table(0.1), flash()):
        light = MovingLight(lighting)
        shades = [light.shade(seen, pixels, c) for c in (plain, lensed)]
        assert torch.allclose(*shades, atol=1e-6)
    away = torch.tensor([[0.0, 0.6, 0.8]])
    assert torch.allclose(in_camera(away, plain), in_camera(away, lensed))


def test_a_whole_turn_of_the_room_sheds_the_same_on_all_sides() -> None:
    light, total = MovingLight(table(0.1)), 0
    first, second = table().turntable.sides  # type: ignore[union-attr]
    seen, pixels = maps(torch.tensor([0.36, 0.48, 0.8])), torch.arange(4)
    for a in 2 * np.pi * np.arange(16) / 16:
        place = AXIS + 2 * (np.cos(a) * first + np.sin(a) * second)
        total = total + light.shade(seen, pixels, camera(place)) / 16
    assert torch.allclose(torch.as_tensor(total), torch.ones(4, 3), atol=1e-4)


def test_a_flash_follows_lambert_and_the_inverse_square() -> None:
    place, depth, room = np.array([0.0, 0.0, -4.0]), 3.0, 0.2
    seen, shot = maps(torch.tensor([0.0, 0.6, -0.8]), depth), camera(place)
    pixel = 3 * SIDE + 5
    found = MovingLight(flash(room=room)).shade(seen, torch.tensor([pixel]), shot)
    pose = shot.cam_from_world.numpy().astype(float)
    ray = np.array([(5.5 - SIDE / 2) / SIDE, (3.5 - SIDE / 2) / SIDE, 1.0])
    towards = np.array([0.1, -0.2, 0.0]) - depth * ray
    distance = np.linalg.norm(towards)
    normal = pose[:3, :3] @ [0.0, 0.6, -0.8]
    cosine = max(0.0, float(normal @ towards / distance))
    expected = room + (1 - room) * cosine * (3.0 / distance) ** 2
    assert found[0].tolist() == pytest.approx([expected] * 3, rel=1e-5)


@pytest.mark.parametrize("lighting", [table(0.1), flash()], ids=["turntable", "flash"])
def test_gradients_are_those_of_finite_differences(lighting: Lighting) -> None:
    light = MovingLight(lighting).double()
    if lighting.kind == "turntable":
        light.frame, light.center, light.rings = (
            t.double() for t in (light.frame, light.center, light.rings)
        )
    else:
        light.lamp = light.lamp.double()
    shot = camera(np.array([0.4, -0.9, 2.9]))
    shot = replace(shot, cam_from_world=shot.cam_from_world.double())
    seen = maps(torch.zeros(3))
    weights = torch.linspace(0.5, 1.5, 3, dtype=torch.double)

    def drawn(normal: Tensor, *parameters: Tensor) -> Tensor:
        names = [name for name, _ in light.named_parameters()]
        there = replace(
            seen,
            normal=normal.expand(SIDE, SIDE, 3),
            alpha=seen.alpha.double(),
            depth=seen.depth.double() if seen.depth is not None else None,
        )
        given = dict(zip(names, parameters, strict=True))
        found: Tensor = torch.func.functional_call(
            _Shade(light), {f"light.{k}": v for k, v in given.items()}, (there, shot)
        )
        return (found * weights).sum()

    normal = torch.tensor([0.1, -0.5, 0.85], dtype=torch.double, requires_grad=True)
    given = [p.detach().clone().requires_grad_() for p in light.parameters()]
    assert torch.autograd.gradcheck(drawn, (normal, *given), eps=1e-5, atol=1e-5)


class _Shade(torch.nn.Module):
    def __init__(self, light: MovingLight) -> None:
        super().__init__()
        self.light = light

    def forward(self, seen: Maps, shot: Pinhole) -> Tensor:
        return self.light.shade(seen, torch.arange(5), shot)


@pytest.mark.parametrize("lighting", [table(0.1), flash()], ids=["turntable", "flash"])
def test_what_was_fitted_is_kept(lighting: Lighting) -> None:
    again = MovingLight(MovingLight(lighting).freeze()).freeze()
    first, second = lighting.record(), again.record()
    flat = [np.concatenate([np.ravel(v) for v in _numbers(r)]) for r in (first, second)]
    assert flat[0] == pytest.approx(flat[1], abs=1e-5)


def _numbers(record: object) -> list[np.ndarray]:
    if isinstance(record, dict):
        return [n for value in record.values() for n in _numbers(value)]
    return [] if isinstance(record, str) else [np.asarray(record, float)]


@pytest.mark.parametrize("mixing", ["adaptive", "sum"])
@pytest.mark.parametrize("local", ["dual", "none"])
def test_a_flash_is_mirrored_with_every_way_of_mixing(mixing: str, local: str) -> None:
    shader = Shader(16, local, mixing, physical=True, flash=True)
    with torch.no_grad():
        assert shader.flash is not None
        shader.flash[:] = 3.0
    directions = torch.nn.functional.normalize(torch.randn(5, 3), dim=-1)
    same, near = torch.full((5,), 0.3), torch.ones(5, 4)
    shown = specular(shader, directions, same, same, near, from_camera=directions)
    assert shown.shape == (5, 3)
    with torch.no_grad():
        shader.flash[:] = -3.0
    assert not torch.allclose(
        shown, specular(shader, directions, same, same, near, from_camera=directions)
    )
