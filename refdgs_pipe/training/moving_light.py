"""Light that moves with the camera or with the room: how it reaches what is drawn.

Turntable: camera and room stand still, so the far field lives in the room's frame, which each
photo sees turned about the table's axis. What a matte surface receives changes with the direction
that it faces in the room: the irradiance of a distant environment is a quadratic polynomial of the
normal (Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment
maps"). Shadows and light between parts of the object are taken to stay as they are.

Flash: a small lamp near the lens. What a matte surface receives falls with the cosine of the angle
to its normal and with the squared distance (Lambert's law, inverse square law). Highlights are
looked up in a second map, in the camera's frame. Shadows are neglected: seen from the lens, a lamp
beside it throws them behind the object.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.ops import Maps, Pinhole

_LEAST = 0.05  # of the mean light reaches every surface
RATE, SHADE_RATE = 2e-3, 1e-2


def harmonics(n: Tensor) -> Tensor:
    """(P, 6) those of degree 1 and 2 of unit vectors (P, 3) that vary about z; unnormalised."""
    x, y, z = n.unbind(-1)
    return torch.stack([x, y, x * y, y * z, x * z, x * x - y * y], -1)


class MovingLight(nn.Module):
    """What is fitted of a light that moves: a room's turn and shade, or its share beside a lamp.

    Args:
        lighting: of the kind "turntable" or "flash"; where the fit starts.
    """

    def __init__(self, lighting: Lighting, device: str = "cpu") -> None:
        super().__init__()
        self.lighting = lighting
        if (t := lighting.turntable) is not None:
            self.turns = nn.Parameter(_tensor([ring.turn for ring in t.rings]))
            self.shades = nn.Parameter(_tensor(t.shade))
            sides = np.stack([t.axis, *t.sides])
            self.frame = _tensor(sides).to(device)
            self.center = _tensor(t.center).to(device)
            self.rings = _tensor([[r.height, r.radius] for r in t.rings]).to(device)
        elif (f := lighting.flash) is not None:
            self.lamp = _tensor(f.lamp).to(device)
            share = min(max(f.room, 1e-3), 1 - 1e-3)
            self.room = nn.Parameter(_tensor([math.log(share / (1 - share))]))
        self.to(device)

    def optimizer(self) -> torch.optim.Adam:
        """Its own, whose rates stay."""
        if self.lighting.turntable is not None:
            groups = [
                {"params": [self.turns], "lr": RATE},
                {"params": [self.shades], "lr": SHADE_RATE},
            ]
        else:
            groups = [{"params": [self.room], "lr": SHADE_RATE}]
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def light_from_world(self, camera: Pinhole) -> Tensor | None:
        """(3, 3) rotation of directions into the room's frame; None where that is the world's.

        The first ring's turn is 0: only differences can be seen.
        """
        if self.lighting.turntable is None:
            return None
        frame, rings = self.frame, self.rings
        place = frame @ (camera.center.detach().to(frame) - self.center)
        radius = torch.linalg.vector_norm(place[1:])
        apart = (rings - torch.stack([place[0], radius])).square().sum(1)
        turns = torch.cat([torch.zeros_like(self.turns[:1]), self.turns[1:]])
        turn = turns.gather(0, apart.argmin()[None])[0]
        return _turned(frame[0], turn - torch.atan2(place[2], place[1]))

    def shade(self, maps: Maps, pixels: Tensor, camera: Pinhole) -> Tensor:
        """(P, 3) the factor of the diffuse radiance at covered pixels (P,).

        Args:
            maps: with normals and depth.
        """
        at = pixels.clamp(min=0)  # of no pixel: any, nothing is made of it
        assert maps.normal is not None and maps.depth is not None
        normal = maps.normal.reshape(-1, 3).index_select(0, at)
        normal = nn.functional.normalize(normal, dim=-1, eps=1e-8)
        if self.lighting.turntable is not None:
            turn = self.light_from_world(camera)
            assert turn is not None
            upright = torch.roll(self.frame, -1, 0) @ turn  # from the world to sides and axis
            return (1 + harmonics(normal @ upright.T) @ self.shades).clamp(min=_LEAST)
        with torch.no_grad():
            alpha = maps.alpha.reshape(-1).index_select(0, at)
            depth = maps.depth.reshape(-1).index_select(0, at) / alpha.clamp(min=1e-6)
            points = _unprojected(at, depth, camera)
        turned = normal @ _rotation(camera).to(normal).T
        towards = self.lamp - points
        distance = torch.linalg.vector_norm(towards, dim=-1).clamp(min=1e-6)
        cosine = ((turned * towards).sum(-1) / distance).clamp(min=0)
        assert self.lighting.flash is not None
        falloff = (self.lighting.flash.distance / distance).square()
        room = torch.sigmoid(self.room)
        share: Tensor = room + (1 - room) * cosine * falloff
        return share[:, None].expand(-1, 3)

    def freeze(self) -> Lighting:
        """The lighting as it was fitted."""
        with torch.no_grad():
            if self.lighting.turntable is not None:
                turns = [0.0, *self.turns[1:].tolist()]
                return self.lighting.with_turns(turns, _array(self.shades))
            assert self.lighting.flash is not None
            room = float(torch.sigmoid(self.room).item())
            return replace(self.lighting, flash=replace(self.lighting.flash, room=room))


def moving(lighting: Lighting | None, device: str = "cpu") -> MovingLight | None:
    """What moves of a lighting; None where the light stands still with the object."""
    if lighting is None or lighting.kind == "world":
        return None
    return MovingLight(lighting, device)


def in_camera(directions: Tensor, camera: Pinhole) -> Tensor:
    """(P, 3) world directions (P, 3) in the camera's frame."""
    return directions @ _rotation(camera).to(directions).T


def _rotation(camera: Pinhole) -> Tensor:
    """(3, 3) of the pose, where recorded work can be given another one."""
    if camera.lens is not None:
        return camera.lens[:12].reshape(3, 4)[:, :3]
    return camera.cam_from_world[:3, :3].detach()


def _unprojected(pixels: Tensor, depth: Tensor, camera: Pinhole) -> Tensor:
    """(P, 3) points at camera depth (P,), in the camera's frame."""
    x = (pixels % camera.width).to(depth) + 0.5
    y = torch.div(pixels, camera.width, rounding_mode="floor").to(depth) + 0.5
    if camera.lens is not None:
        fx, fy, cx, cy = camera.lens[12:16].unbind()
        return torch.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], -1)
    across = (x - camera.cx) / camera.fx * depth
    return torch.stack([across, (y - camera.cy) / camera.fy * depth, depth], -1)


def _turned(axis: Tensor, angle: Tensor) -> Tensor:
    """(3, 3) rotation about a unit axis (3,) by an angle () in radians (Rodrigues' formula)."""
    zero, (x, y, z) = torch.zeros_like(axis[0]), axis.unbind()
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    along = torch.outer(axis, axis)
    still = torch.eye(3, dtype=axis.dtype, device=axis.device) - along
    return along + torch.cos(angle) * still + torch.sin(angle) * cross


def _tensor(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float32)


def _array(tensor: Tensor) -> np.ndarray:
    return np.asarray(tensor.cpu().numpy(), np.float64)
