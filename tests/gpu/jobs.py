"""What is compared between devices: each job gives an operation's outputs and gradients."""

import itertools
from collections.abc import Callable
from dataclasses import fields, replace

import torch
from cases import Case, camera
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.ops import Pinhole, Plan, Surfels, rasterize
from refdgs_pipe.ops.gpu import mlp as network
from refdgs_pipe.ops.registry import backend_of
from refdgs_pipe.training.surfels import step_all

Named = dict[str, Tensor]
Run = Callable[[torch.dtype, str], Named]  # type and device to outputs and gradients


def weighted(parts: Named, seed: int = 5) -> Tensor:
    """A random combination of outputs, the same for every type and device."""
    total: Tensor | None = None
    for k, value in enumerate(parts.values()):
        g = torch.Generator().manual_seed(seed + k)
        pull = (torch.rand(value.shape, generator=g) - 0.3).to(value)
        term = (value * pull).sum()
        total = term if total is None else total + term
    assert total is not None
    return total


def pulled(inputs: Named, run: Callable[[Named], Named]) -> Named:
    """Outputs, and the gradients of their combination by every input."""
    leaves = {k: v.detach().clone().requires_grad_() for k, v in inputs.items()}
    out = run(leaves)
    weighted(out).backward()  # type: ignore[no-untyped-call]
    grads = {f"d/d {k}": v.grad for k, v in leaves.items() if v.grad is not None}
    return {k: v.detach() for k, v in {**out, **grads}.items()}


def drawing(case: Case, *, planned: bool = False, lens: bool = False) -> Run:
    """The rasteriser on a case.

    planned: a second time, with room by what the first one needed. lens: the GPU is told another
    camera, and reads the true one from its memory.
    """
    made, features = case.make()

    def run(dtype: torch.dtype, device: str) -> Named:
        inputs = {f.name: getattr(made, f.name).to(device, dtype) for f in fields(made)}
        view = camera(*case.size)
        # the pose stays on the CPU, as in training
        inputs |= {"features": features.to(device, dtype), "pose": view.cam_from_world.to(dtype)}

        def draw(leaves: Named) -> Named:
            s = Surfels(*(leaves[f.name] for f in fields(Surfels)))
            posed = Pinhole(leaves["pose"], *list(vars(view).values())[1:])
            if lens and backend_of(leaves["means"]) == "gpu":
                numbers = torch.tensor(posed.numbers()).to(leaves["means"])
                other = posed.cam_from_world + 0.2
                posed = replace(posed, cam_from_world=other, fx=50.0, cy=7.0, lens=numbers)
            plan = Plan(device) if planned else None
            for _ in range(1 + planned):
                if plan is not None:
                    plan.begin()
                maps = rasterize(
                    s,
                    leaves["features"],
                    posed,
                    extra=case.extra,
                    normals=case.normals,
                    plan=plan,  # type: ignore[arg-type]
                )
            named = {f.name: getattr(maps, f.name) for f in fields(maps)}
            return {k: v for k, v in named.items() if isinstance(v, Tensor)}

        return pulled(inputs, draw)

    return run


def fused(*, small: bool) -> dict[str, Run]:
    """The other operations."""
    g = torch.Generator().manual_seed(11)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    points, map_height = (150, 16) if small else (100_000, 256)
    widths = [10, 64, 64, 64, 3]
    net = {"x": 2 * random(points, 10) - 1}
    for l, (a, b) in enumerate(itertools.pairwise(widths)):
        net |= {f"w{l}": (random(b, a) - 0.5) * (6 / a) ** 0.5, f"b{l}": random(b) - 0.5}

    def mlp(p: Named) -> Named:
        layers = range(len(widths) - 1)
        return {"out": ops.mlp(p["x"], [p[f"w{l}"] for l in layers], [p[f"b{l}"] for l in layers])}

    def rough(p: Named) -> Named:
        layers = range(len(widths) - 1)
        net = [p[f"w{l}"] for l in layers], [p[f"b{l}"] for l in layers]
        return {"out": ops.mlp(p["x"], *net, half=True)}

    encoding = {
        "map": random(map_height, 2 * map_height, 4) - 0.5,
        "directions": random(points, 3) - 0.5,
        "roughness": random(points),
    }

    def sph_mip(p: Named) -> Named:
        return {"features": ops.sph_mip(p["map"], p["directions"], p["roughness"])}

    def loss(height: int, width: int) -> Run:
        image, target, weight = (
            random(height, width, 3),
            random(height, width, 3),
            random(height, width),
        )

        def run(dtype: torch.dtype, device: str) -> Named:
            y, w = target.to(device, dtype), weight.to(device, dtype)
            inputs = {"image": image.to(device, dtype)}
            error = ops.image_loss_and_error(inputs["image"], y, weight=w)[1]
            made = pulled(inputs, lambda p: {"loss": ops.image_loss(p["image"], y, weight=w)})
            return {**made, "squared error": error}

        return run

    tensors = {f"p{k}": random(points, 3) - 0.5 for k in range(34)}

    def adam(dtype: torch.dtype, device: str) -> Named:
        leaves = {k: v.to(device, dtype).clone().requires_grad_() for k, v in tensors.items()}
        made = torch.optim.Adam(leaves.values(), lr=0.01, eps=1e-15, fused=True)
        for turn in range(3):
            for k, leaf in leaves.items():
                leaf.grad = (tensors[k].flip(0) * 10.0 ** (turn - 3)).to(device, dtype)
            step_all([], [made])
        return {k: v.detach() for k, v in leaves.items()}

    sizes = [(29, 37)] if small else [(1, 1), (5, 70), (217, 333), (800, 800)]
    out = {
        "network": _plain(net, mlp),
        "network, bfloat16": _plain(net, rough),
        "network by multiply-adds": _without_tensor_cores(_plain(net, mlp)),
        "Sph-Mip": _plain(encoding, sph_mip),
        "Adam": adam,
        "photo": _photo((29, 37) if small else (217, 333), g),
        "planned pixels": _planned(random),
        "elementwise": _elementwise(random, points // 50),
        "shading": _shading((29, 37) if small else (217, 333), random),
    }
    return out | {f"image loss {w} x {h}": loss(h, w) for h, w in sizes}


def _plain(inputs: Named, run: Callable[[Named], Named]) -> Run:
    return lambda dtype, device: pulled({k: v.to(device, dtype) for k, v in inputs.items()}, run)


def _photo(size: tuple[int, int], g: torch.Generator) -> Run:
    """A target, and a mask's cross-entropy, from bytes."""
    rgb = torch.randint(0, 256, (3, *size), generator=g).to(torch.uint8)
    mask = torch.randint(-200, 456, size, generator=g).clamp(0, 255).to(torch.uint8)
    alpha, backdrop = 1.2 * torch.rand(size, generator=g) - 0.1, torch.rand(3, generator=g)

    def run(dtype: torch.dtype, device: str) -> Named:
        there, covers = rgb.to(device), mask.to(device)
        target = ops.composited(there, covers, backdrop.to(device, dtype))
        made = pulled(
            {"alpha": alpha.to(device, dtype)},
            lambda p: {"entropy": ops.mask_entropy(p["alpha"], covers, weight=0.3)},
        )
        return {"target": target, **made}

    return run


def _planned(random: Callable[..., Tensor]) -> Run:
    """Half of the pixels, shaded through lists with room to spare."""
    height, width = 117, 133
    inputs = {
        "features": random(height, width, 4),
        "alpha": random(height, width),
        "normal": random(height, width, 3) - 0.5,
        "map": random(64, 128, 4) - 0.5,
        "w0": (random(64, 6) - 0.5) / 2, "b0": random(64) - 0.5,
        "w1": (random(3, 64) - 0.5) / 2, "b1": random(3) - 0.5,
    }  # fmt: skip
    backdrop, view = random(3), camera(width, height)

    def shade(p: Named) -> Named:
        alpha, plan = p["alpha"], Plan(str(p["alpha"].device))
        plan.begin()
        pixels = ops.covered_pixels(alpha, 0.5, plan)
        limit = plan.last() if len(pixels) and bool((pixels < 0).any()) else None
        diffuse, roughness, reflected, cosine, _ = ops.shading_inputs(
            p["features"], alpha, p["normal"], None, pixels, view
        )
        far = ops.sph_mip(p["map"], reflected, roughness, limit=limit)
        x = [far, roughness, cosine]
        weights, biases = [p["w0"], p["w1"]], [p["b0"], p["b1"]]
        radiance = ops.mlp(x, weights, biases, exp_cap=2.0, limit=limit)
        image = ops.composite(diffuse, radiance, pixels, alpha, alpha, backdrop.to(alpha))
        return {"image": image}

    return _plain(inputs, shade)


def _elementwise(random: Callable[..., Tensor], n: int) -> Run:
    """What lies between the other operations, its losses as parts of one total."""
    inputs = {"log scales": random(n, 2), "opacities": random(n), "image": random(n, 7)}
    inputs |= {"diffuse": 8 * random(n, 3), "roughness": random(n), "features": random(n, 4)}
    inputs |= {"radiance": random(n, 3)}
    grad, light, radii = random(n, 3) - 0.5, random(n, 3), random(n) - 0.5
    pixels = torch.arange(n)

    def run(p: Named) -> Named:
        tables = [("diffuse", p["diffuse"]), ("sigmoid", p["roughness"]), ("tanh", p["features"])]
        parts = ops.activated(p["log scales"], p["opacities"], tables)
        named = dict(zip(("scales", "opacity", "carried"), parts, strict=True))
        like = p["image"]
        terms = [
            ops.image_mean(like, weight=0.3, divisor=0.01, whole=False),
            ops.mirrored(p["radiance"], pixels.to(like.device), n, weight=2.0, whole=False),
        ]
        damped = ops.damped(*(t.to(like) for t in (grad, p["radiance"].detach(), light)), 0.5)
        sums, seen, pull = (torch.ones(n).to(like), torch.ones(n).to(like), grad[:, :2].to(like))
        ops.observe([(sums, seen, pull.contiguous(), radii.to(like))], scale=3.0)
        return named | {"total": ops.total(terms), "damped": damped, "sums": sums, "seen": seen}

    return _plain(inputs, run)


def _without_tensor_cores(run: Run) -> Run:
    def other(dtype: torch.dtype, device: str) -> Named:
        network.TENSOR_CORES = False
        try:
            return run(dtype, device)
        finally:
            network.TENSOR_CORES = True

    return other


def _shading(size: tuple[int, int], random: Callable[..., Tensor]) -> Run:
    height, width = size
    alpha = 0.1 + 0.8 * random(height, width)
    inputs = {
        "features": random(height, width, 6),
        "alpha": alpha,
        "normal": random(height, width, 3) - 0.5,
        "near": random(height, width, 4) - 0.5,
        "depth": (2 + random(height, width)) * alpha,
        "radiance": random(height * width // 2, 3),
        "behind": 0.2 * random(height, width, 3),
        "smooth normal": random(height, width, 3) - 0.5,
    }
    solid = (0.7 + random(height, width)).clamp(max=1)
    flat, colors = solid * (2 + 0.01 * random(height, width)), 0.1 * random(height, width, 4)
    pixels, backdrop = torch.arange(0, height * width // 2 * 2, 2), random(3)
    view = camera(width, height)

    def shade(p: Named) -> Named:
        there = pixels.to(p["alpha"].device)
        diffuse, roughness, reflected, cosine, near = ops.shading_inputs(
            p["features"], p["alpha"], p["normal"], p["near"], there, view
        )
        image = ops.composite(
            diffuse, p["radiance"], there, 0.9 * p["alpha"], p["alpha"],
            backdrop.to(p["alpha"]), p["behind"],
        )  # fmt: skip
        images = [t.to(p["alpha"]) for t in (colors, flat, solid, 0.8 * solid)]
        smooth = ops.normal_smoothness(p["smooth normal"], *images, shaded=0.6)
        agreement = ops.normal_agreement(p["normal"], p["depth"], p["alpha"], view, edge=1e3)
        assert near is not None
        named = {"diffuse": diffuse, "roughness": roughness, "reflected": reflected}
        named |= {"cosine": cosine, "near": near}
        sums = {"agreement": agreement * height * width, "smoothness": smooth * height * width}
        return named | {"image": image, **sums}

    return _plain(inputs, shade)
