"""Procedural scenes with exact depth, normals and colours: the truth the tests hold results to."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear

F64 = NDArray[np.float64]
Colour = Callable[[F64], F64]  # world points (N, 3) -> linear colours (N, 3)


@dataclass(frozen=True)
class Sphere:
    """A sphere; `specular` is the reflectance at normal incidence, (3,) linear."""

    center: tuple[float, float, float]
    radius: float
    diffuse: Colour
    roughness: float = 0.5
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: F64) -> F64:
        """(N,) distance of world points (N, 3) to the surface."""
        return np.abs(np.linalg.norm(points - self.center, axis=-1) - self.radius)

    def intersect(self, origin: F64, rays: F64) -> tuple[F64, F64]:
        """Ray parameter (N,), inf for a miss, and outward normals (N, 3)."""
        offset = origin - np.array(self.center)
        a, b = (rays**2).sum(-1), rays @ offset
        root = b**2 - a * (offset @ offset - self.radius**2)
        t = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        t = np.where(t > 1e-9, t, np.inf)
        hit = offset + rays * np.where(np.isfinite(t), t, 0)[:, None]
        return t, hit / self.radius


@dataclass(frozen=True)
class Box:
    """An axis-aligned box between two corners."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    diffuse: Colour
    roughness: float = 0.8
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: F64) -> F64:
        """(N,) distance of world points (N, 3) to the surface."""
        middle, half = (np.add(self.low, self.high)) / 2, (np.subtract(self.high, self.low)) / 2
        q = np.abs(points - middle) - half
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return np.abs(outside + np.minimum(q.max(-1), 0))

    def intersect(self, origin: F64, rays: F64) -> tuple[F64, F64]:
        """Ray parameter (N,), inf for a miss, and outward normals (N, 3)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t1, t2 = (np.array(self.low) - origin) / rays, (np.array(self.high) - origin) / rays
        near, far = np.minimum(t1, t2), np.maximum(t1, t2)
        axis, t = near.argmax(-1), near.max(-1)
        t = np.where((t <= far.min(-1)) & (t > 1e-9), t, np.inf)
        rows = np.arange(len(rays))
        normals = np.zeros_like(rays)
        normals[rows, axis] = -np.sign(rays[rows, axis])
        return t, normals


@dataclass(frozen=True)
class Scene:
    """Solids under an environment `sky`: unit directions (N, 3) -> linear radiance (N, 3)."""

    solids: tuple[Sphere | Box, ...]
    sky: Colour

    def distance(self, points: F64) -> F64:
        """(N,) distance of world points (N, 3) to the nearest surface."""
        return np.min([solid.distance(points) for solid in self.solids], axis=0)

    def diffuse(self, points: F64) -> F64:
        """(N, 3) linear diffuse colour of the solid nearest to each point."""
        nearest = np.argmin([solid.distance(points) for solid in self.solids], axis=0)
        colours = np.stack([solid.diffuse(points) for solid in self.solids])
        return np.asarray(colours[nearest, np.arange(len(points))])

    def surface_map(self, camera: Camera) -> SurfaceMap:
        """What `camera` sees; reflections are one mirror bounce of the sky, Schlick's Fresnel."""
        rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
        hits = [solid.intersect(camera.center, rays) for solid in self.solids]
        ts = np.stack([t for t, _ in hits])
        first, t = ts.argmin(0), ts.min(0)
        seen = np.isfinite(t)
        rows = np.arange(len(rays))
        normals = np.where(seen[:, None], np.stack([n for _, n in hits])[first, rows], 0)
        points = camera.center + rays * np.where(seen, t, 0)[:, None]
        diffuse = np.stack([s.diffuse(points) for s in self.solids])[first, rows]
        f0 = np.array([s.specular for s in self.solids])[first]
        view = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        cosine = -(view * normals).sum(-1, keepdims=True)
        fresnel = np.where(f0 > 0, f0 + (1 - f0) * np.clip(1 - cosine, 0, 1) ** 5, 0)
        specular = fresnel * self.sky(view + 2 * cosine * normals)
        mask = seen[:, None]
        color = srgb_from_linear((diffuse + specular).astype(np.float32)) * mask

        def shaped(values: F64) -> NDArray[np.float32]:
            shape = (camera.height, camera.width, *values.shape[1:])
            return values.reshape(shape).astype(np.float32)

        return SurfaceMap(
            camera,
            depth=shaped(np.where(seen, t, 0)),
            alpha=shaped(seen.astype(float)),
            normal=shaped(normals),
            diffuse=shaped(diffuse * mask),
            specular=shaped(specular * mask),
            roughness=shaped(np.array([s.roughness for s in self.solids])[first] * seen),
            color=shaped(color.astype(float)),
        )


def orbit(
    count: int, *, radius: float = 4.0, size: int = 160, focal: float = 200.0, first: int = 0
) -> list[Camera]:
    """Cameras spread evenly over a sphere (Fibonacci), looking at the origin, z up.

    Args:
        radius: distance to the origin, world units.
        size: width and height in pixels; focal: pixels.
    """
    cameras = []
    for i in range(first, count):
        z = 1 - (2 * i + 1) / count
        turn = i * np.pi * (3 - 5**0.5)
        eye = radius * np.array(
            [np.cos(turn) * (1 - z * z) ** 0.5, np.sin(turn) * (1 - z * z) ** 0.5, z]
        )
        cameras.append(look_at(f"v{i:03d}", eye, size=size, focal=focal))
    return cameras


def look_at(name: str, eye: F64, *, size: int = 160, focal: float = 200.0) -> Camera:
    """A square camera at `eye` looking at the origin, z up."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(name, size, size, K, pose)


def constant(*colour: float) -> Colour:
    """One colour everywhere."""
    return lambda points: np.broadcast_to(np.array(colour), (len(points), 3))


def waves(points: F64) -> F64:
    """A smooth colourful texture, (N, 3) linear in [0.1, 0.7]."""
    phases = np.array([[5.0, 1.0, 2.0], [1.0, 6.0, -2.0], [-2.0, 1.0, 4.0]])
    return np.asarray(0.4 + 0.3 * np.sin(points @ phases.T))


def gradient_sky(directions: F64) -> F64:
    """A bright window in a blue to brown gradient."""
    up = directions[:, 2:] * 0.5 + 0.5
    colour = up * np.array([0.4, 0.6, 1.0]) + (1 - up) * np.array([0.3, 0.2, 0.1])
    window = (directions @ np.array([0.6, 0.0, 0.8]))[:, None] > 0.9
    return np.asarray(colour + 3.0 * window)


def glossy_pair() -> Scene:
    """A glossy textured sphere beside a matte textured box, inside the ball of radius 1.2."""
    return Scene(
        (
            Sphere((-0.45, 0.0, 0.1), 0.5, waves, roughness=0.2, specular=(0.04, 0.04, 0.04)),
            Box((0.2, -0.4, -0.4), (0.9, 0.3, 0.4), waves),
        ),
        gradient_sky,
    )
