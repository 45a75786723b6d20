"""What it costs to make an asset of a trained field: processor seconds and memory of each step.

pytest -m benchmark -s tests/benchmarks/bench_asset.py
"""

import resource
import time

import numpy as np
import pytest
from finished import appearance
from scenes import Scene, Sphere, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.texture import charts, programs
from refdgs_pipe.texture.material import Painter
from refdgs_pipe.texture.programs import PROGRAMS, Program
from refdgs_pipe.texture.refining import Refiner

pytestmark = pytest.mark.benchmark
FACES, VIEWS, SIZE = 50_000, 100, 1024
RINGS = round((FACES / 4) ** 0.5)


def body() -> Mesh:
    """A ball of about FACES triangles with dents all over."""
    solid = sphere(RINGS)
    dented = solid.vertices * (1 + 0.05 * np.sin(9 * solid.vertices).prod(1, keepdims=True))
    return Mesh(dented.astype(np.float32), solid.faces)


def told(name: str, begin: float) -> None:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"\n{name}: {time.process_time() - begin:.1f} core-s, peak {peak:.2f} GB")


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.name)
def test_unwrap(program: Program) -> None:
    mesh = body()
    function = getattr(programs, program.target.partition(":")[2])
    begin = time.process_time()
    corners = function(mesh.vertices, mesh.faces, 4 / 1024, 0.1667, **program.options)
    told(f"{program.name}, {len(mesh.faces)} faces", begin)
    layout = charts.measure(program.name, mesh, charts.unmirrored(corners))
    print(f"charts {layout.charts}, used {layout.used:.3f}, stretch {layout.stretch:.3f}")


def test_bake() -> None:
    mesh = body()
    cut = charts.unwrap(mesh, gutter=4 / 1024, max_stretch=0.1667, timeout_s=600).mesh
    scene = Scene((Sphere((0, 0, 0), 1.0, waves),), gradient_sky)
    begin, drawing = time.process_time(), 0.0
    painter = Painter(cut, SIZE, tolerance=0.1)
    for camera in orbit(VIEWS, size=640, focal=900):
        start = time.process_time()
        view = scene.surface_map(camera)
        drawing += time.process_time() - start
        painter.add(view)
    looks = appearance(mesh.vertices)
    textured = painter.paint(looks)
    name = f"bake, {SIZE} texels, {VIEWS} views of 640 px, {len(mesh.faces)} faces"
    told(name, begin + drawing)

    assert looks.environment is not None
    refiner = Refiner(textured, looks.environment, near=0.1, photos=VIEWS)
    for camera in orbit(VIEWS, size=640, focal=900):
        start = time.process_time()
        view = scene.surface_map(camera)
        photo = Photo(camera, view.color, view.alpha, view.alpha >= 0)
        drawing += time.process_time() - start
        refiner.add(photo)
    refiner.refined()
    told(f"{name}, and corrected by the photos", begin + drawing)
