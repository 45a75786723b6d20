"""Render captures of the proving ground, with truth.

    python tests/proving/make_capture.py --generator GENERATOR --out FOLDER [NAME ...]

GENERATOR is the folder of the capture generator (it has `capture.py`; its README says what to
install: Mitsuba 3, in an environment of its own). Without a name, all captures are rendered.
A second call goes on where the first one stopped. `--list` shows the captures.

Each capture has `images/`, `masks/`, `cameras_gt.json`, `gt_mesh.ply` and `materials.json`, as the
generator's own captures have. Photos have what real ones have and the generator leaves out: lens
distortion, unequal exposure, motion blur and noise.

`--light` renders a recipe under a light that moves, into a folder NAME-LIGHT: a flash in a dark
room, a flash in a bright one, or a round table that turns before a tripod.
"""

import argparse
import json
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np

LIGHTS = ("world", "flash", "world+flash", "turntable")


def main() -> None:
    ap = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    ap.add_argument("names", nargs="*")
    ap.add_argument("--generator", type=Path, required=True)
    ap.add_argument("--out", type=Path, default=Path("captures"))
    ap.add_argument("--passes", type=int, default=1, help="4 samples per pixel each")
    ap.add_argument(
        "--photos", type=int, default=None, help="number of photos, in place of the recipe's"
    )
    ap.add_argument("--only", type=int, default=None, help="render this photo only")
    ap.add_argument("--light", choices=LIGHTS, default="world")
    ap.add_argument("--room", type=float, help="share of the room's light that a flash leaves")
    ap.add_argument("--bare", action="store_true", help="photos without EXIF, as messengers send")
    ap.add_argument("--list", action="store_true")
    a = ap.parse_args()
    sys.path[:0] = [str(a.generator.resolve()), str(Path(__file__).parent)]
    from recipes import RECIPES

    if a.list:
        for name, recipe in RECIPES.items():
            print(f"{name:14} {'checking' if recipe.checking else 'tuning'}")
        return
    for name in a.names or RECIPES:
        out = a.out / (name if a.light == "world" else f"{name}-{a.light}")
        render(out, RECIPES[name], a.light, a)


def render(out: Path, recipe: Any, light: str, wanted: argparse.Namespace) -> None:
    """Write one capture; photos that are there are kept.

    Args:
        wanted: the options.
    """
    import capture
    import env
    import moving
    import walls
    from common import lookat
    from dataset import material_table, visible_mesh

    started = time.time()
    for folder in ("images", "masks"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    width, height = recipe.size
    margin = 1.0 if recipe.lens == (0.0, 0.0) else 1.15
    focal = recipe.focal / 36 * max(width, height)
    large = (round(width * margin), round(height * margin))
    fov = float(np.rad2deg(2 * np.arctan(large[0] / 2 / focal)))
    objects = recipe.objects()
    own = len(objects)
    turns, flashes = light == "turntable", "flash" in light
    objects.append(moving.table(recipe.table(recipe.seed)[::-1], turns, recipe.varnish))
    objects += recipe.beside() if recipe.beside else []
    room, about = 1.0, {"light": light}
    if flashes:
        room = moving.ROOM[light] if wanted.room is None else wanted.room
        about["flash"] = moving.flash(capture, recipe.seed, room)
    # a still background is seen sharply
    wide = 4096 if turns or recipe.inside else 2048
    surroundings = env.build(recipe.room, wide, wide // 2, 1) * np.float32(room)
    if recipe.inside and light == "world":
        room_of = (surroundings, *large, fov, recipe.inside)
        tracer = walls.WalledTracer(objects, *room_of, someone=recipe.someone)
    else:
        tracer = capture.PhotoTracer(objects, surroundings, *large, fov, flashes)
    denoise = capture.OIDN(*large)
    rng = np.random.default_rng(recipe.seed)
    photos = wanted.photos or recipe.photos
    if turns:
        cameras = moving.turntable(photos, rng, recipe.seed)
    else:
        cameras = [
            {"c2w": lookat(eye, at, roll=roll[0] if roll else np.deg2rad(rng.normal(0, 2.5)))}
            for eye, at, *roll in recipe.cameras(photos, rng)
        ]
    poses = [camera["c2w"] for camera in cameras]
    gains = 2.0 ** rng.normal(0, recipe.drift or 1e-9, len(poses))
    tints = 2.0 ** (np.random.default_rng(recipe.seed).normal(0, recipe.tint, (len(poses), 3)))
    shakes = rng.uniform(-1, 1, (len(poses), 2)) * recipe.shake
    frames = []
    for i, pose in enumerate(poses):
        w2c = np.diag([1.0, -1, -1, 1]) @ np.linalg.inv(pose)
        frames.append(
            {
                "file": f"images/IMG_{i:04d}.jpg",
                "transform_matrix": pose.tolist(),
                "world_to_cam": w2c.tolist(),
                **{key: value for key, value in cameras[i].items() if key != "c2w"},
            }
        )
    about |= {
        "width": width,
        "height": height,
        "fx": focal,
        "fy": focal,
        "cx": width / 2,
        "cy": height / 2,
        "k1": recipe.lens[0],
        "k2": recipe.lens[1],
        "table_z": -0.55,
        "frames": frames,
    }
    (out / "cameras_gt.json").write_text(json.dumps(about, indent=1))
    for i, pose in enumerate(poses):
        target = out / "images" / f"IMG_{i:04d}.jpg"
        if target.exists() or (wanted.only is not None and i != wanted.only):
            continue
        tracer.place(cameras[i])
        linear, oid = _traced(capture, tracer, denoise, pose, large, fov, objects, wanted.passes, i)
        exif = None if wanted.bare else _exif(recipe, flashes)
        _write(target, linear, oid < own, recipe, focal, gains[i] * tints[i], shakes[i], rng, exif)
        print(f"{out.name} {i + 1} of {len(poses)}, {time.time() - started:.0f} s", flush=True)
    if wanted.only is not None:
        return
    scene = types.SimpleNamespace(scene=capture.load_scene(objects, None)[0])
    sides = [*objects, *(_turned_over(one) for one in objects)]  # however the faces are wound
    v, f, ids = visible_mesh(scene, {"objects": sides}, [p[:3, 3] for p in poses[::2]])
    ids = ids % len(objects)
    used, inverse = np.unique(f[ids < own].ravel(), return_inverse=True)
    capture.write_ply(out / "gt_mesh.ply", v[used], inverse.reshape(-1, 3))
    np.save(out / "gt_mesh_face_object.npy", ids[ids < own].astype(np.uint8))
    (out / "materials.json").write_text(json.dumps(material_table({"objects": objects}), indent=1))


def _turned_over(one: dict[str, Any]) -> dict[str, Any]:
    """The object with its faces wound the other way."""
    return {**one, "mesh": {**one["mesh"], "F": one["mesh"]["F"][:, ::-1]}}


def _traced(
    capture: Any,
    tracer: Any,
    denoise: Any,
    pose: np.ndarray,
    size: tuple[int, int],
    fov: float,
    objects: list,
    passes: int,
    i: int,
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) linear radiance and (H, W) object numbers of one photo."""
    width, height = size
    py, px = (q.ravel() for q in np.mgrid[0:height, 0:width])
    sums = hits = 0
    for p in range(passes):
        l, h = tracer.trace(pose, px, py, 31337 + i * 1009 + p, allpix=True, n_per=4)
        sums, hits = sums + l, hits + h
    albedo, normal, _ = tracer.features(pose, px, py, 900 + i, 4, allpix=True)

    def square(x: np.ndarray) -> np.ndarray:
        return x.reshape(height, width, -1)

    clean = denoise(square(sums.sum(1) / hits.sum(1)[:, None]), square(albedo), square(normal))
    truth = capture.gt_buffers(tracer.scene, tracer.shapes, objects, pose, width, height, fov)
    return np.maximum(clean, 0) * 0.95, truth["oid"]


def _write(
    path: Path,
    linear: np.ndarray,
    mask: np.ndarray,
    recipe: Any,
    focal: float,
    gain: np.ndarray,
    shake: np.ndarray,
    rng: np.random.Generator,
    exif: bytes | None,
) -> None:
    """Bend, expose, shake and develop one photo; write it with its mask."""
    from common import srgb
    from PIL import Image
    from scipy.ndimage import map_coordinates

    width, height = recipe.size
    h, w = mask.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    xd, yd = (x - width / 2) / focal, (y - height / 2) / focal
    xu, yu = xd.copy(), yd.copy()
    for _ in range(20):  # the inverse of OpenCV's radial distortion
        r2 = xu**2 + yu**2
        bend = 1 + recipe.lens[0] * r2 + recipe.lens[1] * r2**2
        xu, yu = xd / bend, yd / bend

    def seen(image: np.ndarray, dx: float = 0.0, dy: float = 0.0, order: int = 3) -> np.ndarray:
        at = [yu * focal + h / 2 - 0.5 + dy, xu * focal + w / 2 - 0.5 + dx]
        return map_coordinates(image, at, order=order, mode="nearest")

    steps = np.linspace(-0.5, 0.5, 1 if not recipe.shake else 5)
    photo = np.stack(
        [
            np.mean([seen(linear[..., c], t * shake[0], t * shake[1]) for t in steps], 0)
            for c in range(3)
        ],
        -1,
    )
    photo = np.clip(np.maximum(photo, 0) * gain, 0, 1)
    photo = photo + rng.normal(0, 1, photo.shape) * np.sqrt(
        photo * recipe.noise**2 * 20 + recipe.noise**2
    )
    image = Image.fromarray(np.round(srgb(photo) * 255).astype(np.uint8))
    covered = seen(mask.astype(float), order=1) > 0.5
    Image.fromarray(covered).convert("1", dither=Image.Dither.NONE).save(
        path.parents[1] / "masks" / f"{path.stem}.png"
    )
    image.save(path, quality=92, exif=exif or b"")


def _exif(recipe: Any, fired: bool) -> bytes:
    """Lens, and whether the flash fired."""
    import piexif

    lens = {
        piexif.ExifIFD.FocalLength: (int(recipe.focal * 100), 100),
        piexif.ExifIFD.FocalLengthIn35mmFilm: int(recipe.focal),
        piexif.ExifIFD.Flash: int(fired),
    }
    make = {piexif.ImageIFD.Make: b"Proving", piexif.ImageIFD.Model: b"Ground"}
    return bytes(piexif.dump({"0th": make, "Exif": lens}))


if __name__ == "__main__":
    main()
