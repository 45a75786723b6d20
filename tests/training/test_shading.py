"""Drawing a view: what its gradient may turn."""

import pytest
import torch
from torch import Tensor

from refdgs_pipe.ops import Pinhole, Surfels
from refdgs_pipe.training.reflection import Shader
from refdgs_pipe.training.shading import Picture, Scene, draw

SIDE = 24


def mirror(quats: Tensor, diffuse: float) -> Scene:
    """One opaque disc before the camera, in light that varies."""
    torch.manual_seed(0)
    shader = Shader(16, "none", "adaptive", physical=True)
    with torch.no_grad():
        shader.environment.normal_(std=0.3)
    return Scene(
        geometry=Surfels(
            torch.tensor([[0.0, 0.0, 4.0]]),
            quats,
            torch.full((1, 2), 2.0),
            torch.full((1,), 0.99),
        ),
        carried=torch.tensor([[diffuse, diffuse, diffuse, 0.3]]),
        shares=False,
        local=None,
        local_features=None,
        background=None,
        background_rgb=None,
        shader=shader,
    )


def turning(diffuse: float, turn_share: float) -> tuple[Tensor, Picture]:
    """The gradient of the picture's sum by the disc's rotation, and the picture."""
    quats = torch.tensor([[0.95, 0.2, 0.1, 0.0]], requires_grad=True)
    camera = Pinhole(torch.eye(4), SIDE, SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE, near=0.1)
    picture = draw(mirror(quats, diffuse), camera, torch.zeros(3), turn_share=turn_share)
    picture.image.sum().backward()  # type: ignore[no-untyped-call]
    assert quats.grad is not None
    return quats.grad, picture


def test_where_little_is_mirrored_reflections_turn_normals_less() -> None:
    whole, picture = turning(0.5, 0.0)
    half, same = turning(0.5, 0.5)
    least, _ = turning(0.5, 1.0)
    assert torch.equal(picture.image, same.image)
    mirrored = picture.radiance.detach().sum(-1)
    share = float((mirrored / (mirrored + 1.5)).mean())
    assert 0.2 < share < 0.45
    # each is what does not come from reflections, plus share / turn_share of what does
    expected = (share / 0.5 - share) / (1 - share)
    found = (half - least)[0] @ (whole - least)[0] / (whole - least).square().sum()
    assert float(found) == pytest.approx(expected, rel=0.1)


def test_a_mirror_turns_normals_in_full() -> None:
    whole, _ = turning(0.01, 0.0)
    same, _ = turning(0.01, 0.5)
    assert torch.equal(whole, same)
    assert float(whole.abs().max()) > 0
