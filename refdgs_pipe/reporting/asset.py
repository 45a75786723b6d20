"""The mesh: in three dimensions, from all round, and its atlas."""

import tempfile
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.export.gltf import write_glb
from refdgs_pipe.export.product import Product, product
from refdgs_pipe.formatting import counted, size
from refdgs_pipe.reporting.delivery import size_line
from refdgs_pipe.reporting.facts import Drawing, Facts
from refdgs_pipe.reporting.html import Html, figure, image, joined, tag
from refdgs_pipe.reporting.pictures import data_uri, fitted, webp
from refdgs_pipe.texture.texels import rasterize

U8 = NDArray[np.uint8]
VIEWER = "model-viewer-4.4.0.umd.min.js"
_FRAMES, _FRAME, _CLOSE_UP, _ZOOM = 8, 380, 480, 4.0
_MOST_BYTES = 12_000_000  # a larger GLB is embedded with smaller textures
_SHOWN = [  # value in report.js, label
    ("asset", "finished asset"),
    ("color", "colour only"),
    ("rough", "roughness"),
    ("metal", "metal"),
    ("normal", "surface direction"),
    ("seen", "how certain its shape is"),
]
_TEXTURE, _MAP, _LIGHT = 1024, 512, 128  # px, of an embedded GLB, of the page, of its light


def viewer(facts: Facts, _: Drawing) -> Html:
    """The GLB itself, to be turned and zoomed; it starts when asked to."""
    folder = facts.folder(Asset)
    content = (folder / "asset.glb").read_bytes()
    note = f"This is asset.glb, {size(len(content))}."
    large = size_line(facts)
    if len(content) > _MOST_BYTES:
        smaller = _smaller(product_of(facts))
        if len(smaller) > 1.5 * _MOST_BYTES:
            words = f"{note} It is too large for this page: open the file."
            return joined(large, tag("p", words, class_="none"))
        note = f"{note} In this page its textures are reduced to {_TEXTURE} px."
        content = smaller
    library = files("refdgs_pipe.reporting").joinpath("assets", VIEWER).read_text("utf-8")
    library = library.rpartition("//# sourceMappingURL=")[0] or library
    assert "</script" not in library.lower()
    light, seen = _light(folder), _seen(folder)
    poster = data_uri((folder / "preview.png").read_bytes(), "image/png")
    button = tag("button", "Start the 3D view", type="button", id="start-3d")
    words = (
        f"{note} Drag or use the arrow keys to turn it, scroll or pinch to zoom. "
        "Nothing is fetched from anywhere."
    )
    return joined(
        large,
        tag(
            "div",
            tag("img", src=_small_poster(poster, folder), alt="the asset from three sides"),
            button,
            id="stage-3d",
        ),
        _choices(has_light=light is not None, has_seen=seen is not None),
        tag("p", words, class_="hint"),
        tag("script", Html(_base64(content)), type="text/plain", id="glb"),
        tag("script", Html(_base64(light)), type="text/plain", id="light") if light else Html(""),
        tag("script", Html(seen), type="text/plain", id="seen") if seen else Html(""),
        tag("script", Html(library), type="text/plain", id="viewer"),
    )


def _choices(*, has_light: bool, has_seen: bool) -> Html:
    """What of the asset is shown, and in which light; there once the view has started."""
    shown = [(name, label) for name, label in _SHOWN if name != "seen" or has_seen]
    lights = [("studio", "studio"), ("found", "as photographed")] if has_light else []
    wire = tag("input", type="checkbox", id="wire-3d")
    return tag(
        "div",
        _radios("show", "Show", shown),
        _radios("lit", "Light", lights) if lights else Html(""),
        tag("fieldset", tag("legend", "Mesh"), tag("label", wire, " wireframe")),
        tag("p", "", id="told-3d", class_="hint", role="status"),
        id="choices-3d",
        hidden=True,
    )


def _radios(name: str, legend: str, options: list[tuple[str, str]]) -> Html:
    """One of several, as radio buttons; the first is chosen."""
    labels = [
        tag(
            "label",
            tag("input", type="radio", name=name, value=value, checked=i == 0),
            f" {label}",
        )
        for i, (value, label) in enumerate(options)
    ]
    return tag("fieldset", tag("legend", legend), *labels)


def _seen(folder: Path) -> str | None:
    """How certain the shape is at each place of the texture, as a small picture."""
    pixels = cv2.imread(str(folder / "textures" / "confidence.png"), cv2.IMREAD_GRAYSCALE)
    return None if pixels is None else webp(np.asarray(fitted(pixels, _MAP), np.uint8))


def _light(folder: Path) -> bytes | None:
    """The surroundings as a small HDR that the viewer takes: +X in its centre, ours has +Z."""
    found = cv2.imread(str(folder / "environment.hdr"), cv2.IMREAD_UNCHANGED)
    if found is None:
        return None
    small = cv2.resize(found, (2 * _LIGHT, _LIGHT), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".hdr", np.roll(small, _LIGHT // 2, axis=1))[1].tobytes()


def _base64(content: bytes) -> str:
    return data_uri(content, "").partition(",")[2]


def _small_poster(fallback: str, folder: Path) -> str:
    pixels = cv2.imread(str(folder / "preview.png"), cv2.IMREAD_COLOR)
    return fallback if pixels is None else webp(np.asarray(pixels[..., ::-1], np.uint8))


def _smaller(made: Product) -> bytes:
    """A GLB of the product with smaller textures."""
    reduced = replace(
        made,
        base_color=fitted(made.base_color, _TEXTURE),
        roughness=fitted(made.roughness, _TEXTURE),
        metallic=fitted(made.metallic, _TEXTURE),
        occlusion=fitted(made.occlusion, _TEXTURE),
        normal=fitted(made.normal, _TEXTURE),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.glb"
        write_glb(path, reduced, generator="refdgs-pipe report")
        return path.read_bytes()


def turntable(facts: Facts, drawing: Drawing) -> Html:
    """The mesh from all round, painted and as triangles."""
    from refdgs_pipe.export.turntable import render_close_up, render_turntable

    made = product_of(facts)
    turns = render_turntable(made, count=_FRAMES, side=_FRAME, threads=drawing.threads)
    sized = (_FRAME, _FRAME)
    painted = [image(webp(t.painted), f"from side {i}", sized) for i, t in enumerate(turns, 1)]
    wire = [
        image(webp(t.wire, 70), f"triangles from side {i}", sized) for i, t in enumerate(turns, 1)
    ]
    close = render_close_up(made, side=_CLOSE_UP, zoom=_ZOOM)
    near = (_CLOSE_UP, _CLOSE_UP)
    faces = f"{len(made.faces):,} triangles"
    state = "has holes, through which its inside can be seen" if made.is_open else "is closed"
    return joined(
        tag(
            "p",
            f"{faces}; the surface {state}. It stands in a plain studio here, not in the light of "
            "the photos.",
        ),
        tag(
            "div",
            tag("div", *painted, class_="frames"),
            tag("div", *wire, class_="frames"),
            tag("input", type="range", min=0, max=_FRAMES - 1, value=0, aria_label="Turn the mesh"),
            class_="turn",
        ),
        tag(
            "div",
            figure(image(webp(close.painted), "close-up", near), f"close-up, {_ZOOM:g} x"),
            figure(image(webp(close.wire), "close-up of the triangles", near), "its triangles"),
            class_="pair",
        ),
    )


def atlas(facts: Facts, _: Drawing) -> Html:
    """The textures and their charts."""
    textured = facts.load(TexturedMesh)
    side = min(_MAP, textured.size)
    charts, picture, used = chart_map(textured.mesh, side)
    shown = (
        ("pieces of the surface, one colour each", picture),
        ("colour without light", _texture(textured.base_color)),
        ("roughness: white is rough, black is a mirror", _texture(textured.roughness)),
        ("metal: white is metal", _texture(textured.metallic)),
        ("shadow in corners: white is open", _texture(textured.occlusion)),
        ("fine relief (tangent-space normals)", _texture(textured.normal)),
    )
    pictures = [
        figure(image(webp(pixels), label, (pixels.shape[1], pixels.shape[0])), label)
        for label, pixels in shown
    ]
    words = (
        f"The surface is cut into {counted(charts, 'piece')}, which fill {used:.0%} of textures of "
        f"{textured.size} x {textured.size} pixels."
    )
    return joined(tag("p", words), tag("div", *pictures, class_="tripled"))


def chart_map(mesh: UvMesh, side: int) -> tuple[int, U8, float]:
    """How many charts, a (side, side, 4) picture with a colour for each, the share they cover."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f = mesh.faces
    pairs = np.concatenate([f[:, [0, 1]], f[:, [1, 2]]])
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(mesh.vertices),) * 2)
    _, part = connected_components(links, directed=False)
    _, chart = np.unique(part[f[:, 0]], return_inverse=True)
    texels = rasterize(mesh, side)
    palette = np.random.default_rng(7).permutation(
        np.stack(np.meshgrid(*[[96, 136, 176, 216]] * 3), -1).reshape(-1, 3)
    )
    picture = np.zeros((side * side, 4), np.uint8)
    picture[texels.index, :3] = palette[chart.reshape(-1)[texels.face] % len(palette)]
    picture[texels.index, 3] = 255
    count = int(chart.max(initial=-1)) + 1
    return count, picture.reshape(side, side, 4), len(texels.index) / side**2


def _texture(pixels: NDArray[np.uint16]) -> U8:
    return np.asarray(np.asarray(fitted(pixels, _MAP)) // 257, np.uint8)


def product_of(facts: Facts) -> Product:
    """The textured mesh with +Y up, in world units: only its shape matters here."""
    up = facts.load(SparseModel).up
    return product(facts.load(TexturedMesh), up=up, metres_per_unit=1.0)
