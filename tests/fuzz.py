"""Mutated files for every reader: `python tests/fuzz.py --seconds 600 [READER ...]`.

Each input may be read or refused by an error of ours (`RefdgsError`), within a time and within a
limit of memory. Whatever else happens is kept below tests/corpus/READER and printed; test_fuzz.py
replays what is there.
"""

import argparse
import hashlib
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.errors import RefdgsError

CORPUS = Path(__file__).parent / "corpus"
TIME_S = 5.0  # of one input
MEMORY = 8 << 30  # bytes of address space; torch and OpenCV alone reserve some
_WORDS = [
    *(b"\0", b"\xff" * 4, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\xff" * 8, b"\0" * 8),
    *(b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999999999999", b"9" * 5000, b"null"),
    *(b"[", b"{", b"[" * 3000, b'"', b"..", b"../../x", b"/etc/hostname", b"\x1b[2J", b"\xe9"),
    *(b"true", b"[]", b"{}", b'""', b",", b":", b"\n", b" ", b"-", b"."),
]


class Slow(BaseException):
    """An input took longer than `TIME_S`."""


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Args:
        seeds: makes a folder of files that it reads.
        read: reads them; `files` names those to mutate, as a glob.
    """

    seeds: Callable[[Path], None]
    read: Callable[[Path], Any]
    files: str = "*"


def mutated(data: bytes, chance: random.Random) -> bytes:
    """A few random changes: bits, numbers, words, cuts, copies of parts."""
    out = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 3, 6))):
        at = chance.randrange(len(out) + 1)
        size = min(len(out) - at, chance.choice((1, 2, 4, 8, 16, 64)))
        kind = chance.randrange(7)
        if kind == 0 and size:
            out[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            out[at : at + size] = chance.randbytes(size)
        elif kind == 2:
            out[at : at + chance.choice((0, size))] = chance.choice(_WORDS)
        elif kind == 3:
            del out[at : at + chance.choice((size, len(out)))]
        elif kind == 4:
            out[at:at] = out[at : at + size] * chance.choice((1, 2, 100))
        elif kind == 5 and at + 8 <= len(out):
            value = chance.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1))
            out[at : at + 8] = struct.pack(chance.choice("<>") + "Q", value)
        elif kind == 6 and (digits := [i for i, c in enumerate(out[:20_000]) if 48 <= c < 58]):
            i = chance.choice(digits)
            out[i : i + 1] = chance.choice(
                (b"-1", b"0", b"nan", b"1e400", b"null", b'"x"', b"9" * 20)
            )
    return bytes(out)


def attempt(reader: Reader, folder: Path) -> str | None:
    """Read a folder. None if that ended as it should, else what happened."""

    def too_slow(*_: object) -> None:
        raise Slow

    old = signal.signal(signal.SIGALRM, too_slow)
    signal.setitimer(signal.ITIMER_REAL, TIME_S)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader.read(folder)
    except RefdgsError:
        return None
    except Slow:
        return f"slow: more than {TIME_S} s"
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error}"[:200]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    return None


def inputs_of(reader: Reader, place: Path) -> tuple[Path, list[Path]]:
    """A folder with the seeds, and the files of it to mutate."""
    folder = place / "seeds"
    folder.mkdir(parents=True)
    reader.seeds(folder)
    return folder, sorted(path for path in folder.glob(reader.files) if path.is_file())


def run(name: str, *, seconds: float, seed: int, most: int = 1 << 60) -> dict[str, int]:
    """Mutate and read for some time. Return the number of inputs and of each kind of failure."""
    chance, found = random.Random(seed), dict[str, int]()
    end, count = time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory() as place:
        folder, files = inputs_of(READERS[name], Path(place))
        whole = {path: path.read_bytes() for path in files}
        assert attempt(READERS[name], folder) is None, "the seed itself is not read"
        while time.monotonic() < end and count < most:
            path = chance.choice(files)
            data = mutated(whole[path], chance)
            path.write_bytes(data)
            count += 1
            if failure := attempt(READERS[name], folder):
                kind = failure.partition(": ")[0]
                if kind not in found:
                    keep(name, path.relative_to(folder).as_posix(), data)
                    print(f"{name}: {failure}", flush=True)
                found[kind] = found.get(kind, 0) + 1
            path.write_bytes(whole[path])
    return {"inputs": count} | found


def keep(name: str, file: str, data: bytes) -> None:
    """Add an input to the corpus; it is told by the file that it replaces."""
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    mark = hashlib.blake2b(data, digest_size=6).hexdigest()
    (folder / f"{mark}--{file.replace('/', '--')}").write_bytes(data)


def kept(name: str) -> list[tuple[str, Path]]:
    """(file that is replaced, input) of the corpus of a reader."""
    paths = sorted((CORPUS / name).glob("*--*"))
    return [(path.name.partition("--")[2].replace("--", "/"), path) for path in paths]


def replay(name: str, place: Path) -> dict[str, str]:
    """Read every kept input again. Return what failed: input -> how."""
    folder, _ = inputs_of(READERS[name], place)
    failed = {}
    for file, path in kept(name):
        whole = (folder / file).read_bytes()
        shutil.copyfile(path, folder / file)
        if failure := attempt(READERS[name], folder):
            failed[path.name] = failure
        (folder / file).write_bytes(whole)
    return failed


# The readers.


def _artifacts() -> dict[str, tuple[type[Any], Callable[[Path], Any]]]:
    """Name -> artifact and what makes one."""
    import finished

    from refdgs_pipe.artifacts.mesh import Mesh, UvMesh

    def uv(folder: Path) -> Any:
        points = np.eye(3, dtype=np.float32)
        return UvMesh(points, points, points[:, :2], np.array([[0, 1, 2]], np.int32))

    def mesh(folder: Path) -> Any:
        return Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))

    makers: dict[str, Callable[[Path], Any]] = {
        "views": finished.views,
        "model": lambda _: finished.model(),
        "field": lambda _: finished.field(),
        "appearance": lambda _: finished.appearance(np.eye(3, dtype=np.float32)),
        "placement": lambda _: finished.half_placed(),
        "asset": finished.asset,
        "mesh": mesh,
        "uvmesh": uv,
    }
    return {name: (type(make(Path(tempfile.mkdtemp()))), make) for name, make in makers.items()}


def _artifact(kind: type[Any], make: Callable[[Path], Any]) -> Reader:
    def seeds(folder: Path) -> None:
        made = make(folder)
        made.save(folder)

    def load(folder: Path) -> None:
        from refdgs_pipe.pipeline.store import load

        load(kind, folder)

    return Reader(seeds, load, "**/*")


def _colmap(text: bool) -> Reader:
    def seeds(folder: Path) -> None:
        from refdgs_pipe.files import colmap

        camera = colmap.ColmapCamera("OPENCV", 64, 48, np.array([50, 50, 32, 24, 0.1, 0, 0, 0.0]))
        pose = (np.array([1.0, 0, 0, 0]), np.zeros(3))
        points, ids = np.ones((2, 2)), np.array([1, -1])
        images = {i: colmap.ColmapImage(*pose, 1, f"IMG_{i}.jpg", points, ids) for i in (1, 2)}
        one = np.array([1])
        model = colmap.ColmapModel(
            {1: camera}, images, one, np.ones((1, 3)), np.ones((1, 3), np.uint8), np.ones(1)
        )
        colmap.write_model(folder, model, text=text)

    def read(folder: Path) -> None:
        from refdgs_pipe.files import colmap

        colmap.write_model(folder / "again", colmap.read_model(folder))

    return Reader(seeds, read)


def _capture(kind: str) -> Reader:
    def seeds(folder: Path) -> None:
        import json

        from captures import write_photos

        paths = write_photos(folder / "images")
        frames = [
            {"file_path": f"images/{path.name}", "transform_matrix": np.eye(4).tolist()}
            for path in paths
        ]
        record = {"camera_angle_x": 0.7, "frames": frames, "k1": 0.1}
        if kind == "nerfstudio":
            record |= {"w": 64, "h": 48, "fl_x": 50.0, "applied_transform": np.eye(4)[:3].tolist()}
        name = "transforms.json" if kind == "nerfstudio" else "transforms_train.json"
        (folder / name).write_text(json.dumps(record))

    def read(folder: Path) -> None:
        from refdgs_pipe.artifacts.capture import Capture
        from refdgs_pipe.datasets.readers import read_capture

        capture = Capture((folder,))
        capture.files()
        read_capture(capture.layout())

    return Reader(seeds, read, "*.json")


def _file(name: str, write: Callable[[Path], None], read: Callable[[Path], Any]) -> Reader:
    return Reader(lambda folder: write(folder / name), lambda folder: read(folder / name), name)


def _picture(name: str, **options: Any) -> Reader:
    def write(path: Path) -> None:
        from captures import picture
        from PIL import Image

        if options.get("bits") == 16:
            from refdgs_pipe.files.images import write_png

            write_png(path, picture().astype(np.uint16) * 257)
        else:
            Image.fromarray(picture()).save(path, **options)

    def read(path: Path) -> None:
        from refdgs_pipe.files.images import read_photo
        from refdgs_pipe.imaging.metadata import read_exif
        from refdgs_pipe.imaging.raw import is_raw

        is_raw(path)
        read_exif(path)
        read_photo(path)

    return _file(name, write, read)


def _write_ply(path: Path) -> None:
    faces = b"".join(struct.pack(f"<B{n}i", n, *(i % 8 for i in range(n))) for n in (3, 4, 5, 3, 3))
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment a\nelement vertex 8\nproperty float x\n"
        "property float y\nproperty float z\nelement face 5\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    vertices = np.random.default_rng(0).random((8, 3)).astype("<f4").tobytes()
    path.write_bytes(head.encode() + vertices + faces)


def _write_obj(path: Path) -> None:
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 1 2 3\nf 1/1 2/1 3/1 4/1\nf -1 -2 -3\n"
    )


def _write_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(3):
            archive.writestr(f"photos/IMG_{i}.jpg", bytes(range(256)) * 4)


def _unpack(path: Path) -> None:
    from refdgs_pipe.files.archive import unpack_zip

    shutil.rmtree(path.parent / "out", ignore_errors=True)
    unpack_zip(path, path.parent / "out")


def _write_pickle(path: Path) -> None:
    import pickle

    path.write_bytes(pickle.dumps([np.eye(3), np.eye(4)[:3]]))


def _read_pickle(path: Path) -> Any:
    from refdgs_pipe.files.pickled_arrays import read_pickled_arrays

    return read_pickled_arrays(path)


def _write_recipe(path: Path) -> None:
    path.write_text(
        "# Mine.\nextends = 'glossy'\ndraft = true\n[train]\nseed = 3\n[extract]\nvoxel = 0.002\n"
        "[gate]\nup = [0.0, 0.0, 1.0]\n"
    )


def _read_recipe(path: Path) -> None:
    from refdgs_pipe import recipe
    from refdgs_pipe.pipeline.catalog import load_stages

    models = {stage.name: stage.params for stage in load_stages()}
    found = recipe.load(str(path))
    recipe.resolve(found, [f"train.seed={path.read_text('utf-8', 'replace')[:50]}"], models)


def _write_memory(path: Path) -> None:
    from refdgs_pipe.cli.memory import Memory

    Memory((path.parent / "photos",), "glossy", ("train.seed=1",)).write(path.parent)


def _read_memory(path: Path) -> None:
    from refdgs_pipe.cli.workspace import open_workspace
    from refdgs_pipe.pipeline.fingerprint import _read_memory as memory

    open_workspace(path.parent, tell=lambda text: None)
    memory(path)


def _seed_store(folder: Path) -> None:
    from letter_scene import Scene

    scene = Scene(folder)
    scene.run()


def _read_store(folder: Path) -> None:
    from fake_stages import STAGES, Letters
    from letter_scene import SETTINGS

    from refdgs_pipe.pipeline.plan import Pipeline
    from refdgs_pipe.pipeline.store import Store

    pipeline = Pipeline(Letters, STAGES, Store(folder / "work"))
    source = Letters((folder / "letters",))
    pipeline.last_fingerprint()
    for step in pipeline.status(pipeline.fingerprint(source), SETTINGS):
        if step.manifest:
            with suppress(RefdgsError):
                pipeline.store.check(step.manifest)


def _mesh(path: Path) -> Any:
    from refdgs_pipe.artifacts.mesh import Mesh

    return Mesh.adopt(path)


READERS: dict[str, Reader] = {
    "colmap-binary": _colmap(text=False),
    "colmap-text": _colmap(text=True),
    "blender": _capture("blender"),
    "nerfstudio": _capture("nerfstudio"),
    "nero": _file("0-camera.pkl", _write_pickle, _read_pickle),
    "ply": _file("a.ply", _write_ply, _mesh),
    "obj": _file("a.obj", _write_obj, _mesh),
    "zip": _file("a.zip", _write_zip, _unpack),
    "png": _picture("a.png"),
    "png16": _picture("a.png", bits=16),
    "jpeg": _picture("a.jpg"),
    "webp": _picture("a.webp", lossless=True),
    "tiff": _picture("a.tif"),
    "recipe": _file("mine.toml", _write_recipe, _read_recipe),
    "workspace": _file("workspace.json", _write_memory, _read_memory),
    "results": Reader(_seed_store, _read_store, "work/**/*"),
    **{f"artifact-{name}": _artifact(*pair) for name, pair in _artifacts().items()},
}


def main() -> None:
    """Fuzz the readers named, or all, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*", default=[], choices=[[], *READERS])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    bad = 0
    for name in options.readers or READERS:
        found = run(name, seconds=options.seconds, seed=options.seed)
        bad += sum(found.values()) - found["inputs"]
        print(f"{name:20} {found}", flush=True)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
