"""A sheet of what a trained model tells apart, for docs/training.md.

    refdgs-pipe render WORKSPACE --out RENDERS
    python docs/pictures/sheet.py SCENE/test RENDERS WORKSPACE/export/*/environment.hdr sheet.jpg

Rows: two views of photo, render, normals, diffuse, specular, roughness; below, the environment.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from refdgs_pipe.color import srgb_from_linear

TILE = 240


def shown(linear: np.ndarray) -> np.ndarray:
    return np.asarray(srgb_from_linear(np.clip(linear, 0, 1)), np.float32)


def tiles(photo: Path, maps: Path) -> np.ndarray:
    pixels = cv2.imread(str(photo), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255
    alpha = pixels[..., 3:] if pixels.shape[2] == 4 else np.ones_like(pixels[..., :1])
    render = cv2.imread(str(maps.with_suffix(".png"))).astype(np.float32)[..., ::-1] / 255
    with np.load(maps) as found:
        solid = (found["alpha"] > 0.5)[..., None]
        pictures = [
            pixels[..., 2::-1] * alpha + 1 - alpha,
            render,
            np.where(solid, found["normal"] / 2 + 0.5, 1),
            np.where(solid, shown(found["diffuse"]), 1),
            np.where(solid, shown(found["specular"]), 1),
            np.where(solid, found["roughness"][..., None].repeat(3, 2), 1),
        ]
    sized = [
        cv2.resize(p.astype(np.float32), (TILE, TILE), interpolation=cv2.INTER_AREA)
        for p in pictures
    ]
    return np.concatenate(sized, 1)


def main(photos: Path, renders: Path, environment: Path, out: Path) -> None:
    maps = sorted(renders.glob("*.npz"))
    views = maps[0], maps[len(maps) // 2]
    rows = [tiles(photos / f"{m.stem.removeprefix('test_')}.png", m) for m in views]
    light = cv2.imread(str(environment), cv2.IMREAD_UNCHANGED)[..., ::-1]
    width = rows[0].shape[1]
    light = cv2.resize(shown(light), (width // 3, width // 6), interpolation=cv2.INTER_AREA)
    rows.append(np.concatenate([light, np.ones((width // 6, width - width // 3, 3))], 1))
    sheet = np.rint(np.concatenate(rows)[..., ::-1] * 255).astype(np.uint8)
    cv2.imwrite(str(out), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
